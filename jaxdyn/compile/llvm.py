"""Operations on numbers as lines of LLVM's intermediate representation: every number is a vector over W samples of a batch."""

import functools
import struct
from collections.abc import Sequence

import numpy as np

from jaxdyn.compile.program import COMPARISONS, FLOATS

_TYPES = {"f8": "double", "f4": "float", "b1": "i1", "i1": "i8", "i4": "i32", "i8": "i64"}  # i1: a bool in memory
_BYTES = {"f8": 8, "f4": 4, "b1": 1, "i1": 1, "i4": 4, "i8": 8}
_FLOAT = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_INTEGER = {"add": "add", "sub": "sub", "mul": "mul", "and": "and", "or": "or"}
_COMPARED = {"eq": "oeq", "ne": "une", "lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge"}
_INTRINSICS = {
    "sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil", "round": "roundeven", "max": "maximum", "min": "minimum",
}  # fmt: skip
# Functions of the C library, called for one sample after the other: LLVM has no vector versions of them without a library that
# would have to be shipped.
_LIBRARY = {
    "tan": "tan", "asin": "asin", "acos": "acos", "atan": "atan", "sinh": "sinh", "cosh": "cosh", "tanh": "tanh", "exp": "exp",
    "exp2": "exp2", "expm1": "expm1", "log": "log", "log1p": "log1p", "cbrt": "cbrt", "pow": "pow", "atan2": "atan2",
    "rem": "fmod",
}  # fmt: skip

# pi/2 in three parts: k times each of the first two is exact for the integers k up to 2^23 (2^13 in float32), so that the
# reduced argument is right to rounding for |x| up to MAX_ANGLE (Cody & Waite 1980, ch. 8). Beyond, k x has more digits than
# the parts leave room for; from 1e17 on what is left of x is no angle any more, and polynomials of it have no bound.
HALF_PI = {
    "f8": (1.570796325802803, 9.920935791635221e-10, 5.170182981794105e-19),
    "f4": (1.5703125, 4.837512969970703e-04, 7.549789954891882e-08),
}
MAX_ANGLE = {"f8": 1.3e7, "f4": 1.2e4}
# (sin x - x)/x^3 and (cos x - 1 + x^2/2)/x^4 as polynomials in x^2 on |x| <= pi/4: Chebyshev fits made with 200 bits (mpmath
# chebyfit), off by 2e-17 and 1e-18 in float64, 2e-8 and 2e-9 in float32.
SINE = {
    "f8": (
        -0.16666666666666666,
        0.008333333333330936,
        -0.00019841269836740527,
        2.7557316093196066e-06,
        -2.5051129895962807e-08,
        1.5917988944318716e-10,
    ),
    "f4": (-0.16666664656310706, 0.008332747104372895, -0.000195876390357926),
}
COSINE = {
    "f8": (
        0.041666666666666664,
        -0.0013888888888887389,
        2.48015872987544e-05,
        -2.7557317265876615e-07,
        2.087614504910828e-09,
        -1.1382544623404291e-11,
    ),
    "f4": (0.04166666465348729, -0.0013888301867270142, 2.4547689709382208e-05),
}

# Comparisons of stores grow with the square of this number and fences with its inverse; 8, 32 and 128 compile equally fast.
STORES_BETWEEN_FENCES = 32


class Emitter:
    """Lines of LLVM IR for operations on vectors of W samples."""

    def __init__(self, width: int):
        self.width = width
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.count = self.stores = 0
        self.sines: dict[str, tuple[str, str]] = {}

    def emit(self, text: str) -> str:
        """The name of the result of an instruction."""
        self.count += 1
        name = f"%x{self.count}"
        self.lines.append(f"  {name} = {text}")
        return name

    def type(self, kind: str) -> str:
        """Type of one number for all samples of a vector."""
        return _TYPES[kind] if self.width == 1 else f"<{self.width} x {_TYPES[kind]}>"

    def constant(self, value, kind: str) -> str:
        """A known number, in every element of a vector."""
        if kind in FLOATS:
            rounded = float(np.float32(value)) if kind == "f4" else float(value)
            text = "0x" + struct.pack(">d", rounded).hex().upper()
        elif kind == "b1":
            text = "true" if value else "false"
        else:
            text = str(int(value))
        return text if self.width == 1 else f"splat ({_TYPES[kind]} {text})"

    def call(self, name: str, kind: str, *args: str) -> str:
        """Call an intrinsic of LLVM on vectors."""
        short = {"f8": "f64", "f4": "f32"}[kind]
        full = f"llvm.{name}.{short if self.width == 1 else f'v{self.width}{short}'}"
        of = self.type(kind)
        self.declared[full] = f"declare {of} @{full}({', '.join([of] * len(args))})"
        return self.emit(f"call {of} @{full}({', '.join(f'{of} {a}' for a in args)})")

    def library(self, name: str, kind: str, *args: str) -> str:
        """Call a function of the C library for each sample."""
        # Attribute #1 says that the function touches no memory, so that LLVM may move it. Nobody reads the errno that it sets.
        name, scalar = (name if kind == "f8" else f"{name}f"), _TYPES[kind]
        self.declared[name] = f"declare {scalar} @{name}({', '.join([scalar] * len(args))}) #1"
        if self.width == 1:
            return self.emit(f"call {scalar} @{name}({', '.join(f'{scalar} {a}' for a in args)})")
        result, of = "poison", self.type(kind)
        for element in range(self.width):
            each = [self.emit(f"extractelement {of} {a}, i32 {element}") for a in args]
            value = self.emit(f"call {scalar} @{name}({', '.join(f'{scalar} {a}' for a in each)})")
            result = self.emit(f"insertelement {of} {result}, {scalar} {value}, i32 {element}")
        return result

    # --- operations ---

    def operation(self, op: str, kind: str, args: Sequence[str], given: str) -> str:
        """An operation; `kind` is that of its result, `given` that of its last operand."""
        of = self.type(kind)
        if op in _FLOAT and kind in FLOATS:
            # Without LLVM's licences such as "contract" or "reassoc": results are those of the text at every level.
            return self.emit(f"{_FLOAT[op]} {of} {args[0]}, {args[1]}")
        if op in _INTEGER:
            return self.emit(f"{_INTEGER[op]} {of} {args[0]}, {args[1]}")
        if op == "neg":
            return self.emit(
                f"fneg {of} {args[0]}" if kind in FLOATS else f"sub {of} {self.constant(0, kind)}, {args[0]}"
            )
        if op in COMPARISONS:
            sign = "" if op in ("eq", "ne") else ("u" if given == "b1" else "s")
            word = f"fcmp {_COMPARED[op]}" if given in FLOATS else f"icmp {sign}{op}"
            return self.emit(f"{word} {self.type(given)} {args[0]}, {args[1]}")
        if op == "not":
            return self.emit(f"xor {of} {args[0]}, {self.constant(1 if kind == 'b1' else -1, kind)}")
        if op == "select":
            return self.emit(f"select {self.type('b1')} {args[0]}, {of} {args[2]}, {of} {args[1]}")
        if op == "stop_gradient":  # for derivatives alone
            return args[0]
        if op == "convert":
            return self.convert(args[0], given, kind)
        if op == "is_finite":
            size = self.call("fabs", given, args[0])
            return self.emit(f"fcmp olt {self.type(given)} {size}, {self.constant(np.inf, given)}")
        if op in ("sin", "cos"):
            return self.sine_and_cosine(args[0], kind)[op == "cos"]
        if op == "sign" and kind in FLOATS:
            return self.sign(args[0], kind)
        if op in ("reduce_max", "reduce_min"):
            pick = op.removeprefix("reduce_")
            # Each once: of the entries of a large matrix most are zero.
            return functools.reduce(lambda a, b: self.operation(pick, kind, (a, b), kind), dict.fromkeys(args))
        if op == "clamp":
            low, x, high = args
            return self.operation("min", kind, (self.operation("max", kind, (x, low), kind), high), kind)
        if op in ("max", "min") and kind == "b1":
            return self.emit(f"{'or' if op == 'max' else 'and'} {of} {args[0]}, {args[1]}")
        if op in ("max", "min") and kind not in FLOATS:
            flag = self.emit(f"icmp s{'gt' if op == 'max' else 'lt'} {of} {args[0]}, {args[1]}")
            return self.emit(f"select {self.type('b1')} {flag}, {of} {args[0]}, {of} {args[1]}")
        if kind not in FLOATS:
            raise AssertionError(f"{op} of integers, which `expand` refuses")
        if op in _INTRINSICS:
            return self.call(_INTRINSICS[op], kind, *args)
        return self.library(_LIBRARY[op], kind, *args)

    def multiply_add(self, kind: str, a: str, b: str, c: str) -> str:
        """a b + c, rounded once where the processor can."""
        # Which of the two is decided by the processor's features alone, not by LLVM's level.
        return self.call("fmuladd", kind, a, b, c)

    def add_product(self, op: str, kind: str, factors: Sequence[str], other: str, is_first: bool) -> str:
        """The sum or difference, by `op`, of a product and another number; `is_first` if the product is the first operand."""
        a, b = factors
        if op == "sub" and is_first:
            other = self.operation("neg", kind, (other,), kind)
        elif op == "sub":
            a = self.operation("neg", kind, (a,), kind)
        return self.multiply_add(kind, a, b, other)

    def convert(self, x: str, source: str, target: str) -> str:
        """A number as another kind."""
        if target == "b1":
            zero = self.constant(0, source)
            word = "fcmp une" if source in FLOATS else "icmp ne"
            return self.emit(f"{word} {self.type(source)} {x}, {zero}")
        if source in FLOATS and target in ("i4", "i8"):  # saturated, and 0 for what is not a number, as XLA does
            to = self.type(target)
            kinds = (f"i{8 * _BYTES[target]}", f"f{8 * _BYTES[source]}")
            full = "llvm.fptosi.sat." + ".".join(kinds if self.width == 1 else (f"v{self.width}{k}" for k in kinds))
            self.declared[full] = f"declare {to} @{full}({self.type(source)})"
            return self.emit(f"call {to} @{full}({self.type(source)} {x})")
        wider = _BYTES[target] > _BYTES[source]
        words = {
            "ff": "fpext" if wider else "fptrunc",
            "bf": "uitofp",
            "if": "sitofp",
            "bi": "zext",
            "ii": "sext" if wider else "trunc",
        }
        return self.emit(f"{words[source[0] + target[0]]} {self.type(source)} {x} to {self.type(target)}")

    def sign(self, x: str, kind: str) -> str:
        """-1, 0, 1, or not a number."""
        of, flag, zero = self.type(kind), self.type("b1"), self.constant(0, kind)
        up, down = (self.emit(f"fcmp {word} {of} {x}, {zero}") for word in ("ogt", "olt"))
        low = self.emit(f"select {flag} {down}, {of} {self.constant(-1, kind)}, {of} {x}")
        return self.emit(f"select {flag} {up}, {of} {self.constant(1, kind)}, {of} {low}")

    def sine_and_cosine(self, x: str, kind: str) -> tuple[str, str]:
        """(sin x, cos x) to about one unit in the last place, of any angle: both share the reduction of x."""
        if x in self.sines:
            return self.sines[x]

        def constant(value):
            return self.constant(value, kind)

        def multiply_add(a, b, c):
            return self.multiply_add(kind, a, b, c)

        def mul(a, b):
            return self.operation("mul", kind, (a, b), kind)

        def polynomial(coefficients, z):
            value = constant(coefficients[-1])
            for coefficient in coefficients[-2::-1]:
                value = multiply_add(z, value, constant(coefficient))
            return value

        # Sine and cosine share the reduction and both polynomials: joints need the pair, and a second function costs two selects.
        turns = self.call("roundeven", kind, mul(x, constant(2 / np.pi)))
        r = x
        for part in HALF_PI[kind]:
            r = multiply_add(turns, constant(-part), r)
        z = mul(r, r)
        sine = multiply_add(mul(r, z), polynomial(SINE[kind], z), r)
        cosine = multiply_add(mul(z, z), polynomial(COSINE[kind], z), multiply_add(z, constant(-0.5), constant(1)))
        # The quadrant is turns modulo 4, as bits of an integer: turns + 1.5 2^52 has them at its end.
        whole, magic = ("i8", 1.5 * 2**52) if kind == "f8" else ("i4", 1.5 * 2**23)
        bits = self.emit(
            f"bitcast {self.type(kind)} {self.operation('add', kind, (turns, constant(magic)), kind)} to {self.type(whole)}"
        )
        of, flag = self.type(kind), self.type("b1")

        def bit(value, mask):
            kept = self.emit(f"and {self.type(whole)} {value}, {self.constant(mask, whole)}")
            return self.emit(f"icmp ne {self.type(whole)} {kept}, {self.constant(0, whole)}")

        odd, high = bit(bits, 1), bit(bits, 2)
        next_bits = self.emit(f"add {self.type(whole)} {bits}, {self.constant(1, whole)}")
        next_high = bit(next_bits, 2)
        signed = []
        for first, second, negative in ((sine, cosine, high), (cosine, sine, next_high)):
            value = self.emit(f"select {flag} {odd}, {of} {second}, {of} {first}")
            minus = self.emit(f"fneg {of} {value}")
            signed.append(self.emit(f"select {flag} {negative}, {of} {minus}, {of} {value}"))
        self.sines[x] = self._or_far(x, kind, (signed[0], signed[1]))
        return self.sines[x]

    def _or_far(self, x: str, kind: str, near: tuple[str, str]) -> tuple[str, str]:
        """The pair, or that of the C library for samples whose angle is beyond the reduction.

        A branch that is never taken costs a comparison. It is taken where one sample is far. The others keep their numbers,
        so that no sample depends on its neighbours in the vector.
        """
        of, flags = self.type(kind), self.type("b1")
        self.count += 1
        before, far, after = (f"{name}{self.count}" for name in ("near", "far", "after"))
        # The label is for the two numbers that are merged below, which name the block that they come from.
        self.lines += [f"  br label %{before}", f"{before}:"]
        size = self.call("fabs", kind, x)
        is_far = self.emit(f"fcmp ogt {of} {size}, {self.constant(MAX_ANGLE[kind], kind)}")
        # LLVM lays the rare block out of line.
        self.declared["far"] = '!0 = !{!"branch_weights", i32 1, i32 1000000}'
        self.lines += [f"  br i1 {self.any(is_far)}, label %{far}, label %{after}, !prof !0", f"{far}:"]
        pair = f"{{{of}, {of}}}"
        # A function of this module, by the C library.
        name, inner = f"far_pair_{kind}_{self.width}", Emitter(self.width)
        of_library = [inner.library(function, kind, "%x") for function in ("sin", "cos")]
        first = inner.emit(f"insertvalue {pair} poison, {of} {of_library[0]}, 0")
        both = inner.emit(f"insertvalue {pair} {first}, {of} {of_library[1]}, 1")
        head = f"define internal {pair} @{name}({of} %x) noinline cold nounwind {{"
        self.declared |= inner.declared
        self.declared[name] = "\n".join([head, *inner.lines, f"  ret {pair} {both}", "}"])
        both = self.emit(f"call {pair} @{name}({of} {x})")
        exact = [self.emit(f"extractvalue {pair} {both}, {k}") for k in (0, 1)]
        chosen = [self.emit(f"select {flags} {is_far}, {of} {a}, {of} {b}") for a, b in zip(exact, near, strict=True)]
        self.lines += [f"  br label %{after}", f"{after}:"]
        sine, cosine = (
            self.emit(f"phi {of} [ {a}, %{before} ], [ {b}, %{far} ]") for a, b in zip(near, chosen, strict=True)
        )
        return sine, cosine

    def any(self, flags: str) -> str:
        """Reduce flags: true where one is set in any element."""
        if self.width == 1:
            return flags
        name, of = f"llvm.vector.reduce.or.v{self.width}i1", self.type("b1")
        self.declared[name] = f"declare i1 @{name}({of})"
        return self.emit(f"call i1 @{name}({of} {flags})")

    # --- memory ---

    def rows(self, places: Sequence[int], sizes: Sequence[int]) -> dict[int, list[str]]:
        """Pointers to the rows of arrays for the W samples from `%base` on."""
        index = []
        for element in range(self.width):
            # Samples beyond the last one repeat it: a masked load and store would cost each block, and this costs the last alone.
            at = self.emit(f"add i64 %base, {element}")
            inside = self.emit(f"icmp ult i64 {at}, %last")
            index.append(self.emit(f"select i1 {inside}, i64 {at}, i64 %last"))
        pointers = {}
        for place, size in zip(places, sizes, strict=True):
            offsets = [self.emit(f"mul i64 {i}, {size}") for i in index]
            pointers[place] = [self.emit(f"getelementptr i8, ptr %a{place}, i64 {o}") for o in offsets]
        return pointers

    def load(self, rows: Sequence[str], entry: int, kind: str) -> str:
        """Load an entry of the rows of all samples."""
        of, value = self.type(kind), "poison"
        for element, row in enumerate(rows):
            x = self.load_one(row, entry, kind)
            if self.width == 1:
                return x
            value = self.emit(f"insertelement {of} {value}, {_TYPES[kind]} {x}, i32 {element}")
        return value

    def load_for_all(self, place: int, entry: int, kind: str) -> str:
        """An entry of an argument that is the same for all samples.

        Read in every block: one number in memory is an operand of a vector instruction (a broadcast load). A vector that is kept
        from block to block would be spilled, and takes W times the memory.
        """
        value = self.load_one(f"%a{place}", entry, kind)
        return value if self.width == 1 else self.splat(value, kind)

    def splat(self, value: str, kind: str) -> str:
        """Broadcast one number to all samples."""
        of = self.type(kind)
        first = self.emit(f"insertelement {of} poison, {_TYPES[kind]} {value}, i32 0")
        return self.emit(f"shufflevector {of} {first}, {of} poison, <{self.width} x i32> zeroinitializer")

    def load_at(self, array: str, k: int, kind: str) -> str:
        """Load entry k of an array in memory whose entries follow each other, each with its W samples."""
        at = self.emit(f"getelementptr i8, ptr {array}, i64 {k * _BYTES[kind] * self.width}")
        if kind != "b1":
            return self.emit(f"load {self.type(kind)}, ptr {at}")
        wide = self.emit(f"load {self.type('i1')}, ptr {at}")
        return self.emit(f"trunc {self.type('i1')} {wide} to {self.type('b1')}")

    def store_at(self, array: str, k: int, kind: str, value: str) -> None:
        """Write such an entry."""
        at = self.emit(f"getelementptr i8, ptr {array}, i64 {k * _BYTES[kind] * self.width}")
        if kind == "b1":
            kind, value = "i1", self.emit(f"zext {self.type('b1')} {value} to {self.type('i1')}")
        self.emit_store(f"  store {self.type(kind)} {value}, ptr {at}")

    def load_one(self, row: str, entry: int, kind: str) -> str:
        """Load an entry of the row of one sample."""
        at = self.emit(f"getelementptr i8, ptr {row}, i64 {entry * _BYTES[kind]}")
        if kind != "b1":
            return self.emit(f"load {_TYPES[kind]}, ptr {at}, align {_BYTES[kind]}")
        return self.emit(f"trunc i8 {self.emit(f'load i8, ptr {at}')} to i1")

    def transpose(self, square: Sequence[str], kind: str) -> list[str]:
        """Transpose a W x W matrix of vectors: blocks of 1, 2, 4 ... entries change places, which are shuffles of two vectors."""
        square, of, distance = list(square), self.type(kind), 1
        while distance < self.width:
            for i in range(self.width):
                if i & distance:
                    continue
                first, second = square[i], square[i + distance]
                for place, step in ((i, 0), (i + distance, distance)):
                    mask = [
                        t + step if not t & distance else self.width + t - distance + step for t in range(self.width)
                    ]
                    indices = ", ".join(f"i32 {t}" for t in mask)
                    square[place] = self.emit(
                        f"shufflevector {of} {first}, {of} {second}, <{self.width} x i32> <{indices}>"
                    )
            distance *= 2
        return square

    def load_tile(self, rows: Sequence[str], entry: int, kind: str) -> list[str]:
        """Load W entries of the rows of all samples, one vector load a row, and transpose them."""
        of, loaded = self.type(kind), []
        for row in rows:
            at = self.emit(f"getelementptr i8, ptr {row}, i64 {entry * _BYTES[kind]}")
            loaded.append(self.emit(f"load {of}, ptr {at}, align {_BYTES[kind]}"))
        return self.transpose(loaded, kind)

    def store_tile(self, rows: Sequence[str], entry: int, kind: str, values: Sequence[str]) -> None:
        """Write W entries of the rows of all samples, one vector store a row."""
        of = self.type(kind)
        if any(value.startswith("%") for value in values):
            lines = self.transpose(values, kind)
        else:  # known numbers, "splat (double 0x...)": the same line for all
            known = ", ".join(value.removeprefix("splat (").removesuffix(")") for value in values)
            lines = [f"<{known}>"] * self.width
        for row, value in zip(rows, lines, strict=True):
            at = self.emit(f"getelementptr i8, ptr {row}, i64 {entry * _BYTES[kind]}")
            self.emit_store(f"  store {of} {value}, ptr {at}, align {_BYTES[kind]}")

    def emit_store(self, line: str) -> None:
        """Write a store, and now and then a fence, which costs no instruction.

        LLVM's schedulers compare every two stores between two fences, which without these grows with the square of the results.
        """
        self.lines.append(line)
        self.stores += 1
        if self.stores % STORES_BETWEEN_FENCES == 0:
            self.lines.append('  fence syncscope("singlethread") release')

    def store_array(self, rows: Sequence[str], kind: str, values: Sequence[str]) -> None:
        """Write all entries of the rows of all samples."""
        # Rows of samples are far from each other in memory: W results of W samples are transposed in registers, so that each row
        # takes one store, not W.
        tiled = len(values) // self.width * self.width if self.width > 1 and kind in FLOATS else 0
        for entry in range(0, tiled, self.width):
            self.store_tile(rows, entry, kind, values[entry : entry + self.width])
        for entry in range(tiled, len(values)):
            self.store(rows, entry, kind, values[entry])

    def store(self, rows: Sequence[str], entry: int, kind: str, value: str) -> None:
        """Write an entry of the rows of all samples."""
        for element, row in enumerate(rows):
            x = value if self.width == 1 else self.emit(f"extractelement {self.type(kind)} {value}, i32 {element}")
            self.store_one(row, entry, kind, x)

    def store_one(self, row: str, entry: int, kind: str, value: str) -> None:
        """Write an entry of the row of one sample."""
        at = self.emit(f"getelementptr i8, ptr {row}, i64 {entry * _BYTES[kind]}")
        if kind == "b1":
            self.emit_store(f"  store i8 {self.emit(f'zext i1 {value} to i8')}, ptr {at}")
        else:
            self.emit_store(f"  store {_TYPES[kind]} {value}, ptr {at}, align {_BYTES[kind]}")
