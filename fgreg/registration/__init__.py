"""Registration from no first guess: minima, outliers, posterior, verdict, and which shot comes next."""
