"""The tiles that exist against the checksums of their manifests."""
