"""Reports of commands as JSON: nested objects with a ``schema`` key, and with units in the names of quantities.

A field never changes its meaning under the same schema; there may be more of them later.
"""
