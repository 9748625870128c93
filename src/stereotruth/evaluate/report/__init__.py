"""Pages that stand alone: of a city, of a site, and the index of all."""
