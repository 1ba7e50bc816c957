"""The way to disk of everything that the commands write: complete or absent, in place of nothing but its older self."""
