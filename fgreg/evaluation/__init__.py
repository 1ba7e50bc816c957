"""Evaluation: errors against ground truth, cross-validation, number of pairs, influence of each pair, tables, plots."""
