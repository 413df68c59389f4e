"""Grids in files, both ways: map_server, GeoTIFF, NetCDF, Zarr, logs, pictures, arrays. Only here do maps flip."""
