"""Numbers of a function that is written as LLVM's intermediate representation, with the operators of Python."""

from functools import partialmethod

from jaxdyn.compile.llvm import Emitter


class Number:
    """A float64 number of a function that is being written, or with `kind` b1 or i8 a flag or an integer."""

    def __init__(self, e: Emitter, name: str, kind: str = "f8"):
        self.e, self.name, self.kind = e, name, kind

    def text_of(self, x) -> str:
        """A number, or a known one of the same kind, as an operand."""
        return x.name if isinstance(x, Number) else self.e.constant(x, self.kind)

    def apply(self, op: str, *others, kind: str = "") -> "Number":
        """An operation of this number and others; `kind`: that of its result, if it is another one."""
        names = [self.name, *map(self.text_of, others)]
        return Number(self.e, self.e.operation(op, kind or self.kind, names, self.kind), kind or self.kind)

    __add__ = partialmethod(apply, "add")
    __sub__ = partialmethod(apply, "sub")
    __mul__ = partialmethod(apply, "mul")
    __truediv__ = partialmethod(apply, "div")
    __neg__ = partialmethod(apply, "neg")
    __and__ = partialmethod(apply, "and")
    __or__ = partialmethod(apply, "or")
    __lt__ = partialmethod(apply, "lt", kind="b1")
    __gt__ = partialmethod(apply, "gt", kind="b1")
    is_equal = partialmethod(apply, "eq", kind="b1")
    is_not_equal = partialmethod(apply, "ne", kind="b1")

    def __rsub__(self, x):
        return constant(self, x) - self

    def __rtruediv__(self, x):
        return constant(self, x) / self

    def select(self, yes, no):
        """`yes` where this flag is set, else `no`; one of them may be known."""
        one = yes if isinstance(yes, Number) else no if isinstance(no, Number) else Number(self.e, "")
        names = [one.text_of(x) for x in (no, yes)]
        return Number(self.e, self.e.operation("select", one.kind, [self.name, *names], one.kind), one.kind)

    def call(self, name: str, *others):
        """An intrinsic of LLVM."""
        return Number(self.e, self.e.call(name, "f8", self.name, *map(self.text_of, others)))

    def abs(self):
        """The number without its sign."""
        return self.call("fabs")

    def fma(self, b, c):
        """This number times b plus c, rounded once."""
        return self.call("fma", b, c)

    def write(self, line: str, kind: str):
        """A line of LLVM, in which {} is this number."""
        return Number(self.e, self.e.emit(line.format(self.name)), kind)

    def bits(self):
        """The number's bits as an integer."""
        return self.write("bitcast double {} to i64", "i8")

    def shift(self, word: str, by: int):
        """An integer whose bits are shifted."""
        return self.write(f"{word} i64 {{}}, {by}", "i8")

    def from_bits(self):
        """The number with the bits of this integer."""
        return self.write("bitcast i64 {} to double", "f8")

    def convert(self, kind: str):
        """The number as an integer, or the reverse."""
        return Number(self.e, self.e.convert(self.name, self.kind, kind), kind)


def constant(x: Number, value) -> Number:
    """A known float64 number in the function of another one."""
    return Number(x.e, x.e.constant(value, "f8"))
