"""Incremental smoothing: recent pairs as factors in iSAM2, everything older as one marginal prior."""
