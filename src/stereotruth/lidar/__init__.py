"""Stage ingest. In: LAS, LAZ or COPC files, their CRS, a geoid. Out: point stores."""
