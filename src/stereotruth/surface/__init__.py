"""Surface: points of LiDAR to facets and breaklines over the ground; knows no image."""
