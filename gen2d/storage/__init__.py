"""Files and folders, local or at a URL: atomic publication, retries, hashes, a cache, compression."""
