"""Power cuts on a block device: what an ext4 file system on it holds afterwards, and whether everything starts."""
