"""Native kernels on CUDA devices: the text of the CPU's kernels as PTX, one thread a sample."""
