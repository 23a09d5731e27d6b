"""Generators of pictures and tables in the documents."""
