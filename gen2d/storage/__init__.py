"""Files and folders, local or at a URL: atomic publication, hashes, a cache, compression."""
