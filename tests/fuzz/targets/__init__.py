"""Everything that takes bytes from outside, one module each, all of the same shape.

``PARSERS``: files whose coverage counts. ``MEGABYTES``: of a full run. ``seeds()``: well-formed inputs. ``mend(data)``:
sums made right again, so that damage reaches what lies behind them. ``feeder()``: what takes one input; it raises where
anything but the parser's own refusal comes out, and where sound bytes after it are not understood.
"""

NAMES = ("scip", "adc", "modbus", "udp", "stream", "toml", "map", "log")
