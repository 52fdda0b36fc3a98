"""Vectors and matrices of single numbers whose structural zeros and ones cost nothing.

An entry is an array of shape () or, where it is known while tracing, the Python integer 0, 1 or -1 (or a Python float).
Sums and products with 0, 1 and -1 are not emitted. Under `jax.vmap` every entry becomes one vector over the batch, which is
the layout in which XLA:CPU vectorises a recursion over bodies best.
"""

SYMMETRIC = ((0, 1, 2), (1, 3, 4), (2, 4, 5))  # place of entry (r, c) among the six numbers xx, xy, xz, yy, yz, zz
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
ZERO3 = (0, 0, 0)
EYE3 = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def is_zero(a) -> bool:
    """Whether an entry is the structural zero."""
    return type(a) is int and a == 0


def vanishes(vector) -> bool:
    """Whether all entries are structural zeros."""
    return all(is_zero(x) for x in vector)


def is_identity(rows) -> bool:
    """Whether a 3x3 matrix is structurally the identity."""
    return all(
        type(x) is int and x == y for row, eye in zip(rows, EYE3, strict=True) for x, y in zip(row, eye, strict=True)
    )


def add(*terms):
    """Sum of entries."""
    total = 0
    for term in terms:
        total = term if is_zero(total) else total if is_zero(term) else total + term
    return total


def sub(a, b):
    """a - b."""
    return a if is_zero(b) else -b if is_zero(a) else a - b


def mul(a, b):
    """a b."""
    if is_zero(a) or is_zero(b):
        return 0
    for x, y in ((a, b), (b, a)):
        if type(x) is int and x in (1, -1):
            return y if x == 1 else -y
    return a * b


def dot(a, b):
    """Sum of products."""
    return add(*(mul(x, y) for x, y in zip(a, b, strict=True)))


def vadd(*vectors):
    """Sum of vectors."""
    return tuple(add(*entries) for entries in zip(*vectors, strict=True))


def vsub(a, b):
    """a - b for vectors."""
    return tuple(sub(x, y) for x, y in zip(a, b, strict=True))


def scale(s, a):
    """s a for a vector a."""
    return tuple(mul(s, x) for x in a)


def cross(a, b):
    """a x b."""
    return tuple(sub(mul(a[i], b[j]), mul(a[j], b[i])) for i, j in ((1, 2), (2, 0), (0, 1)))


def apply(matrix, vector):
    """Matrix times vector."""
    return tuple(dot(row, vector) for row in matrix)


def transpose(matrix):
    """Transposed matrix."""
    return tuple(zip(*matrix, strict=True))


def matmul(a, b):
    """Product of two matrices."""
    columns = transpose(b)
    return tuple(tuple(dot(row, column) for column in columns) for row in a)


def symmetric_rows(six):
    """Rows of the symmetric matrix with the numbers (xx, xy, xz, yy, yz, zz)."""
    return tuple(tuple(six[k] for k in row) for row in SYMMETRIC)


def skew_rows(a):
    """Rows of hat(a)."""
    return ((0, sub(0, a[2]), a[1]), (a[2], 0, sub(0, a[0])), (sub(0, a[1]), a[0], 0))
