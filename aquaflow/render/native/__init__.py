"""C++ kernels and what builds them. Importable without torch."""
