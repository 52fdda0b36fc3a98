"""Numbers of bodies from which on a quantity is computed by loops in native code, whose size does not grow with the bodies.

What is written out keeps the zeros of each body, and is not slower for small trees; LLVM takes 50 microseconds an operation. Each
limit is where compiling what is written out takes one to three seconds of a processor, its optimisation included. Measured on
chains and binary trees in general geometry, on two cores of an AMD EPYC: microseconds a sample alone and in a batch of 128, or 32
of shallow trees, and seconds of the processor to compile both kernels.

| quantity, bodies | written out | loops |
|---|---|---|
| forward kinematics, 64 | 5.8, 0.45; 2.1 s | 6.1, 0.54; 0.9 s |
| forward kinematics, 64, axes at right angles | 4.7, 0.18; 0.7 s | 4.9, 0.29; 0.7 s |
| mass matrix, chain of 24 (300 pairs) | 5.2, 0.25; 1.5 s | 16, 1.5; 0.6 s |
| mass matrix, chain of 44 (990 pairs) | 8.1, 0.94; 5.8 s | 25, 4.2; 0.7 s |
| mass matrix, chain of 60 (1830 pairs) | more than 60 000 operations | 43, 6.3; 0.9 s |
| mass matrix, shallow tree of 140 (509 pairs) | 12, 3.1; 7.3 s | 75, 28; 1.5 s |
| mass matrix, shallow tree of 300 (878 pairs) | 36, 13; 23 s, of which the first calls 3.5 | 214, 482; 4.2 s |
"""

# Kinematics, and sums over the bodies.
MIN_BODIES_IN_LOOPS = 64
# The recursions of forward and inverse dynamics (see `recursions.sweeps`). In general geometry sweeps are as fast from 15 on;
# where axes are at right angles every body that is written out has zeros of its own.
MIN_BODIES_IN_SWEEPS = 40
# Those of robots with floating bases, most of whose axes are at right angles; within other kernels, where what is written out
# shares its numbers with the rest; and of joints without sweeps, for which loops of all kinds are slower.
MAX_BODIES = 128
# Pairs of a body and one above it, or itself: each is some 60 operations of a mass matrix. Its loops are slower at every size, as
# they compute the products of all pairs of bodies.
MAX_PAIRS = 1000
# Bodies of a shallow tree, whose pairs are few: the first call takes three seconds for 300.
MAX_BODIES_IN_MATRIX = 400
