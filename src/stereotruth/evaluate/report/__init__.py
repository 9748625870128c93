"""The page of a city that stands alone: figures, pictures of every tile, tables."""
