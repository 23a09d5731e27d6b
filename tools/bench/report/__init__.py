"""Reports of runs on a bench: results, pictures, pages, and the comparison with another run."""
