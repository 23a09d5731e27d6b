"""SE(2) transforms, small and sparse linear algebra, and the JIT decorator of all kernels."""
