"""Stage ingest. In: points or rasters of heights, their CRS, a geoid. Out: point stores.

Also what the strips of a site are off, and catalogues of tiles.
"""
