"""The field's filter, its whitened innovations, and statistics of regressions on them."""
