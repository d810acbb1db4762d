"""Work boats, ROVs, AUVs and towed bodies."""
