"""How good is it: errors against a truth, held-out pairs, number of pairs, influence of each; tables and plots."""
