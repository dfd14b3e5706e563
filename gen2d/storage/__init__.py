"""Files and folders, here or at a URL: published whole or not at all, hashed, cached, compressed."""
