"""``lumiloop config``: makes, shows and changes a configuration file."""
