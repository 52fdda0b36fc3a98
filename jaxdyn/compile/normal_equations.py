"""Pseudo-inverses (Y^T Y)^-1 Y^T of regular matrices by loops over rows of vectors, whose code does not grow with the matrix.

Entries that are zero are passed over while the loops run, so that sparse matrices, such as the rows of large mechanisms, cost
what their other entries do.
"""

import numpy as np

from jaxdyn.compile.matrix_loops import LoopWriter


def write_normal_equations(w: LoopWriter, matrix, result, n: int, m: int, least: float):
    """Write the inverse (m, n) of Y (n, m), and whether it is accurate: its least pivot above `least` times the largest.

    Gram matrix, Cholesky factor R^T R, two triangular solutions, and a step of Newton and Schulz, which restores the accuracy of
    an orthogonal method: normal equations square the condition number.
    """
    b, zero, one, rows, last = w.b, w.integer(0), w.number(1), w.integer(m), w.integer(m - 1)
    Y, Yt, G, R, X, Z = (w.rows(*shape) for shape in ((n, m), (m, n), (m, m), (m, m), (m, n), (m, n)))
    w.copy_rows(matrix, m, 1, Y)
    w.copy_rows(matrix, 1, m, Yt)
    largest = w.variable(w.float, w.number(0))
    with w.loop(zero, rows) as i:
        own = w.at(G.memory, (i, G.stride))
        w.add_rows(own, Y, w.at(Y.memory, (i, 1)), Y.stride, zero, w.integer(n))
        square, so_far = w.load(w.at(own, (i, 1))), w.load(largest)
        b.store(b.select(b.fcmp_ordered(">", square, so_far), square, so_far), largest)
    # Columns of zeros, which are of rows that were dropped, get the largest square, so that theirs is never the least pivot.
    fill = b.select(b.fcmp_ordered(">", w.load(largest), w.number(0)), w.load(largest), one)
    most, fewest = w.variable(w.float, w.number(0)), w.variable(w.float, fill)
    minus, inverses = w.buffer(m), w.buffer(m)
    with w.loop(zero, rows) as i:
        own = w.at(R.memory, (i, R.stride))
        with w.loop(zero, i) as k:
            b.store(b.fneg(w.load(w.at(R.memory, (k, R.stride), (i, 1)))), w.at(minus, (k, 1)))
        w.add_rows(own, R, minus, 1, zero, i, start=w.at(G.memory, (i, G.stride)), first=i)
        at = w.at(own, (i, 1))
        pivot, square = w.load(at), w.load(w.at(G.memory, (i, G.stride), (i, 1)))
        pivot = b.select(b.fcmp_ordered("==", square, w.number(0)), fill, pivot)
        # What is not a number replaces the least, and is in all later rows.
        b.store(b.select(b.fcmp_unordered("<", pivot, w.load(fewest)), pivot, w.load(fewest)), fewest)
        b.store(b.select(b.fcmp_ordered(">", pivot, w.load(most)), pivot, w.load(most)), most)
        inverse = b.fdiv(one, w.root(pivot))
        b.store(inverse, w.at(inverses, (i, 1)))
        w.add_rows(own, R, minus, 1, zero, zero, start=own, scale=inverse, first=i)
        # Forward: Z = R^-T Y^T.
        w.add_rows(
            w.at(Z.memory, (i, Z.stride)), Z, minus, 1, zero, i, start=w.at(Yt.memory, (i, Yt.stride)), scale=inverse
        )
    with w.loop(zero, rows) as back:
        i = b.sub(last, back)
        factors = w.at(R.memory, (i, R.stride))
        with w.loop(b.add(i, w.integer(1)), rows) as k:
            b.store(b.fneg(w.load(w.at(factors, (k, 1)))), w.at(minus, (k, 1)))
        inverse = w.load(w.at(inverses, (i, 1)))
        own, start = w.at(X.memory, (i, X.stride)), w.at(Z.memory, (i, Z.stride))
        w.add_rows(own, X, minus, 1, b.add(i, w.integer(1)), rows, start=start, scale=inverse)
    # X + E X with E = 1 - X Y, whose transpose has the entries of Y for factors: these may be sparse, the inverse hardly is. Of E
    # what is below rounding changes nothing.
    Xt, Et = w.rows(n, m), G
    w.copy_rows(X.memory, 1, X.stride, Xt)
    eps = w.number(float(np.finfo(w.dtype).eps))
    with w.loop(zero, rows) as j:
        own = w.at(Et.memory, (j, Et.stride))
        w.add_rows(own, Xt, w.at(Y.memory, (j, 1)), Y.stride, zero, w.integer(n))
        with w.loop(zero, rows) as i:
            at = w.at(own, (i, 1))
            error = b.fsub(b.select(b.icmp_signed("==", i, j), one, w.number(0)), w.load(at))
            is_rounding = b.fcmp_ordered("<=", w.size(error), eps)
            b.store(b.select(is_rounding, w.number(0), error), at)
    with w.loop(zero, rows) as i:
        improved = w.at(Z.memory, (i, Z.stride))
        w.add_rows(improved, X, w.at(Et.memory, (i, 1)), Et.stride, zero, rows, start=w.at(X.memory, (i, X.stride)))
        with w.loop(zero, w.integer(n)) as k:
            b.store(w.load(w.at(improved, (k, 1))), w.at(result, (i, n), (k, 1)))
    return b.fcmp_ordered(">", b.fdiv(w.load(fewest), w.load(most)), w.number(least))
