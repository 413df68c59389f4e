"""Grid files, read and written: map_server, GeoTIFF, NetCDF, Zarr, logs, pictures, arrays. Axes are flipped here."""
