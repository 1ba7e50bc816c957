"""Registration without an initial guess: multi-start minima, outliers, posterior, verdict, and the next shot."""
