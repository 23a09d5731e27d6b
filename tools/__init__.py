"""Off the robot: simulated building, benchmarks, converters, demo. Nothing in daemon, hal or estimator imports this."""
