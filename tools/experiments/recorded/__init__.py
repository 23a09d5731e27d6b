"""Experiments on recordings of others: a testbed of visible light positioning."""
