"""Towns, traffic and lidars that make training data: sensor points with their evidential truth grids."""
