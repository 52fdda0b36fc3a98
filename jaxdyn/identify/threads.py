"""One thread for linear algebra on small matrices.

OpenBLAS shares products and factorisations of a hundred rows among all processors, whose threads then wait for each other: on two
busy processors a search for terms took 61 s of their time instead of 4.
"""

from threadpoolctl import threadpool_limits


def on_one_thread():
    """Decorator: numpy's and scipy's linear algebra keeps to one thread while the function runs, in the whole process."""
    return threadpool_limits.wrap(limits=1, user_api="blas")
