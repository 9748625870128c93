"""Surface models judged. In: a GeoTIFF of heights, LiDAR or a reference raster. Out: a verdict."""
