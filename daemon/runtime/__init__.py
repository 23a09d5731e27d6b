"""The cycle at run time: input, estimator step, caps, degradation, background worker, warm-up and monitoring."""
