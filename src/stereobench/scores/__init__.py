"""A dataset's pairs matched by methods, scored, and compared in tables and a page."""
