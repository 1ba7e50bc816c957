"""Tests of fgreg; a package so that they can share helpers (``tests.forward``)."""
