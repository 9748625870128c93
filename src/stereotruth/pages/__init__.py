"""What all pages share: the page itself, tables, charts, pictures."""
