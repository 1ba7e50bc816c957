"""While a session runs: has the camera moved, does an earlier registration fit again."""
