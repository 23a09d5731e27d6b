"""SE(2), small and sparse linear algebra, and the JIT decorator of all kernels."""
