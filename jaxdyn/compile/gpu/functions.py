"""Functions of the C library as LLVM's intermediate representation, for processors that have no C library.

Each is one function of a module, in float64. That of float32 is the same function, rounded: its argument and its
result are exact to many digits more than are kept. Errors are at most some four units in the last place.

Source: Muller, Elementary Functions (2016), for the reductions; polynomials are Taylor's where no other source is named.
"""

import functools
import itertools
import math
from collections.abc import Callable
from functools import partialmethod

from jaxdyn.compile.llvm import COSINE, SINE, Emitter
from jaxdyn.compile.operations import pi_with_bits

# --- numbers of a function that is written as LLVM's intermediate representation, with the operators of Python ---


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


# --- coefficients ---

# ln 2 in two parts: k times the first is exact for the exponents k of float64.
LN2_HIGH, LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
HALF_PI_HIGH, HALF_PI_LOW = 1.5707963267948966, 6.123233995736766e-17
# (atan(x)/x - 1)/x^2 as a polynomial in x^2 on |x| <= tan(pi/8): a Chebyshev fit made with 200 bits (mpmath chebyfit), off by
# 1e-18.
ATAN = (
    -0.3333333333333333, 0.19999999999999804, -0.14285714285659828, 0.11111111105155447, -0.09090908753500877,
    0.07692296375032143, -0.06666424885738255, 0.05878928997834775, -0.05230454270650244, 0.04551593220626549,
    -0.034570561981427744, 0.016285756855221028,
)  # fmt: skip
EXP = tuple(1 / math.factorial(k) for k in range(2, 15))  # (e^x - 1 - x)/x^2 on |x| <= ln(2)/2, off by 1e-18
LOG = tuple(2 / (2 * k + 3) for k in range(11))  # (2 atanh(s) - 2 s)/s^3 as a polynomial in s^2 on s^2 <= 0.03
INF, NAN = math.inf, math.nan


def _polynomial(x: Number, coefficients) -> Number:
    value = constant(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value.fma(x, coefficient)
    return value


# --- exponentials ---


def _power_of_two(k: Number) -> Number:
    """2^k for an integer k of a normal number."""
    return (k + 1023).shift("shl", 52).from_bits()


def _reduce_exp(x: Number) -> tuple[Number, Number]:
    """e^r - 1 and the integer k with x = k ln 2 + r, for |x| up to 1100."""
    k = (x * (1 / math.log(2))).call("roundeven")
    r = k.fma(-LN2_LOW, k.fma(-LN2_HIGH, x))
    return (r * r).fma(_polynomial(r, EXP), r), k


def _scale(x: Number, k: Number) -> Number:
    """Number x times 2^k in two steps, each of which is a normal number."""
    k = k.convert("i8")
    half = k.shift("ashr", 1)
    return x * _power_of_two(half) * _power_of_two(k - half)


def _clamp(x: Number) -> Number:
    return x.call("minnum", 1100.0).call("maxnum", -1100.0)


def _exp(x: Number) -> Number:
    p, k = _reduce_exp(_clamp(x))
    return x.is_equal(x).select(_scale(p + 1.0, k), x)


def _exp2(x: Number) -> Number:
    near = _clamp(x)
    k = near.call("roundeven")
    r = near - k
    r = (r * math.log(2)) + r * 2.3190468138462996e-17  # the rounding error of ln 2
    return x.is_equal(x).select(_scale((r * r).fma(_polynomial(r, EXP), r) + 1.0, k), x)


def _expm1(x: Number) -> Number:
    p, k = _reduce_exp(x.call("minnum", 40.0).call("maxnum", -80.0))
    scale = _power_of_two(k.convert("i8"))
    near = p.fma(scale, scale - 1.0)
    near = (x.abs() < 1e-300).select(x, near)  # with the sign of zero
    return (x.is_equal(x) & (x < 40.0)).select(near, _exp(x))


def _half_of_exp(x: Number) -> Number:
    """e^x / 2, which is finite up to larger x than e^x."""
    half = _exp(x * 0.5)
    return half * 0.5 * half


def _sinh(x: Number) -> Number:
    a = x.abs()
    t = _expm1(a)
    return (a < 22.0).select((t + t / (t + 1.0)) * 0.5, _half_of_exp(a)).call("copysign", x)


def _cosh(x: Number) -> Number:
    a = x.abs()
    e = _exp(a)
    return (a < 22.0).select((e + 1.0 / e) * 0.5, _half_of_exp(a))


def _tanh(x: Number) -> Number:
    t = _expm1((x.abs() * 2.0).call("minimum", 80.0))
    return (t / (t + 2.0)).call("copysign", x)


# --- logarithms ---


def _mantissa(x: Number) -> tuple[Number, Number]:
    """Number m between the root of a half and that of two, and k, with x = m 2^k for finite x above zero."""
    is_small = x < 2.0**-1022
    bits = is_small.select(x * 2.0**54, x).bits()
    minimum = 0x3FE6A09E667F3BCD  # the bits of the root of a half
    k = (bits - minimum).shift("ashr", 52)
    m = (bits - k.shift("shl", 52)).from_bits()
    return m, k.convert("f8") - is_small.select(54.0, 0.0)


def _with_special_values(x: Number, value: Number) -> Number:
    """A logarithm with its values at zero, at infinity and below zero."""
    value = x.is_equal(INF).select(INF, value)
    value = x.is_equal(0.0).select(-INF, value)
    return ((x > 0.0) | x.is_equal(0.0)).select(value, NAN)


def _log(x: Number) -> Number:
    m, k = _mantissa(x)
    f = m - 1.0
    s = f / (f + 2.0)
    z = s * s
    half = f * f * 0.5
    # The sum begins with the smallest term: log(1 + f) = f - (f^2/2 - s (f^2/2 + s^2 P(s^2))).
    rest = half - (s * (half + z * _polynomial(z, LOG)) + k * LN2_LOW)
    return _with_special_values(x, k * LN2_HIGH - (rest - f))


def _log1p(x: Number) -> Number:
    # The error of 1 + x is taken back by a quotient (Kahan, in Goldberg 1991, theorem 4).
    u = x + 1.0
    value = _log(u) * (x / (u - 1.0))
    value = x.is_equal(INF).select(INF, value)
    return u.is_equal(1.0).select(x, x.is_equal(-1.0).select(-INF, value))


def _cbrt(x: Number) -> Number:
    a = x.abs()
    y = _exp(_log(a) * (1 / 3))
    y = y - (y - a / (y * y)) * (1 / 3)  # a step of Newton's method
    return ((a > 0.0) & (a < INF)).select(y.call("copysign", x), x)


def _pow(x: Number, y: Number) -> Number:
    a = x.abs()
    m, k = _mantissa(a)
    # log m as the sum of two numbers: s = f/d with d = m + 1, and the rounding errors of f, d and s.
    f, d = m - 1.0, m + 1.0
    s = f / d
    rest = (-s).fma(m - (d - 1.0), (-s).fma(d, f)) / d
    z = s * s
    high = s * 2.0
    low = rest * 2.0 + s * z * _polynomial(z, LOG)
    whole = k * LN2_HIGH
    total = whole + high
    # Where the whole is zero the sum is exact; elsewhere it is the larger one.
    low = low + (high - (total - whole)) + k * LN2_LOW
    both = total + low
    low = low - (both - total)
    log = _with_special_values(a, both)
    product = y * log
    lost = y.fma(log, -product) + y * low
    lost = (product.abs() < 1000.0).select(lost, 0.0)
    value = _exp(product)
    value = (value < INF).select(value + value * lost, value)
    # Powers of numbers below zero.
    is_whole = y.call("floor").is_equal(y)
    is_odd = is_whole & (y * 0.5).call("floor").is_not_equal(y * 0.5)
    is_negative = x.bits() < 0
    value = (is_negative & is_odd).select(-value, value)
    is_real = (x > 0.0) | x.is_equal(0.0) | is_whole | a.is_equal(INF)
    value = (is_real & x.is_equal(x) & y.is_equal(y)).select(value, NAN)
    is_one = x.is_equal(1.0) | y.is_equal(0.0) | (x.is_equal(-1.0) & y.abs().is_equal(INF))
    return is_one.select(1.0, value)


# --- angles ---


def _atan2(y: Number, x: Number) -> Number:
    a, b = y.abs(), x.abs()
    is_steep = a > b
    smaller, larger = is_steep.select(b, a), is_steep.select(a, b)
    # Sums of huge numbers would overflow.
    scale = (larger > 1e300).select(0.25, 1.0)
    both = larger.is_equal(INF) & smaller.is_equal(INF)
    smaller, larger = both.select(1.0, smaller * scale), both.select(1.0, larger * scale)
    is_far = smaller > larger * math.tan(math.pi / 8)
    t = is_far.select(smaller - larger, smaller) / is_far.select(smaller + larger, larger)
    t = larger.is_equal(0.0).select(0.0, t)
    z = t * t
    angle = (t * z).fma(_polynomial(z, ATAN), t)
    angle = angle + is_far.select(HALF_PI_HIGH / 2, 0.0)
    angle = is_steep.select((-angle + HALF_PI_LOW) + HALF_PI_HIGH, angle)
    is_back = x.bits() < 0
    angle = is_back.select((-angle + 2 * HALF_PI_LOW) + 2 * HALF_PI_HIGH, angle)
    return (x.is_equal(x) & y.is_equal(y)).select(angle.call("copysign", y), x + y)


def _cosine_of_arc(x: Number) -> Number:
    return ((1.0 - x) * (x + 1.0)).call("sqrt")


def _tan(x: Number) -> Number:
    sine, cosine = x.e.sine_and_cosine(x.name, "f8")
    return (x.abs() < 1e-9).select(x, Number(x.e, sine) / Number(x.e, cosine))  # with the sign of zero


def _far_angle(x: Number) -> tuple[Number, Number, Number, Number]:
    """Sine and cosine of r and bits 0 and 1 of n as flags, with x = n pi/2 + r and |r| <= pi/4, for |x| above 2^13.

    Words of 2/pi are multiplied by the 53 bits of x in integers of 64 bits, without the words that give whole turns
    (Payne & Hanek 1983).
    """
    e = x.e
    bits = x.abs().bits()
    n = (bits & (2**52 - 1)) | 2**52
    # 2^e times bit j of 2/pi, of weight 2^-j, is no whole turn where j >= e - 1; a word of zeros stands before the point.
    place = bits.shift("lshr", 52) - 1075 + 64 - 2
    word, shift = place.shift("lshr", 6), place & 63
    words = []
    for k in range(4):
        at = e.emit(f"getelementptr i64, ptr @jaxdyn_two_over_pi, i64 {(word + k).name}")
        words.append(e.emit(f"load i64, ptr {at}"))
    e.declared["fshl"] = "declare i64 @llvm.fshl.i64(i64, i64, i64)"
    high, middle, low = (
        e.emit(f"call i64 @llvm.fshl.i64(i64 {a}, i64 {b}, i64 {shift.name})") for a, b in itertools.pairwise(words)
    )

    def wide(op, a, b):
        return e.emit(f"{op} i128 {a}, {b}")

    def take_low_bits(a):
        return e.emit(f"trunc i128 {a} to i64")

    n, high, middle, low = (e.emit(f"zext i64 {w} to i128") for w in (n.name, high, middle, low))
    total = wide("add", wide("mul", n, middle), wide("lshr", wide("mul", n, low), 64))
    total = wide("add", wide("shl", wide("mul", n, high), 64), total)
    fraction = wide("shl", total, 2)  # beyond the two bits of whole quarters
    quarters = Number(e, take_low_bits(wide("lshr", total, 126)), "i8")
    top, bottom = (Number(e, take_low_bits(x), "i8") for x in (wide("lshr", fraction, 64), fraction))
    quarters = quarters + (top < 0).select(Number(e, "1", "i8"), 0)
    rest = bottom.write("uitofp i64 {} to double", "f8")
    part = top.convert("f8") * 2.0**-64 + rest * 2.0**-128
    r = part * HALF_PI_HIGH
    r = r + (part.fma(HALF_PI_HIGH, -r) + part * HALF_PI_LOW)
    z = r * r
    sine = (r * z).fma(_polynomial(z, SINE["f8"]), r)
    cosine = (z * z).fma(_polynomial(z, COSINE["f8"]), z.fma(-0.5, 1.0))
    return sine, cosine, (quarters & 1).is_equal(1), (quarters & 2).is_equal(2)


def _sin(x: Number) -> Number:
    sine, cosine, odd, high = _far_angle(x)
    value = odd.select(cosine, sine)
    value = (high.select(-value, value)) * constant(x, 1.0).call("copysign", x)
    return (x.abs() < INF).select(value, NAN)


def _cos(x: Number) -> Number:
    sine, cosine, odd, high = _far_angle(x)
    value = odd.select(-sine, cosine)
    return (x.abs() < INF).select(high.select(-value, value), NAN)


FUNCTIONS: dict[str, Callable] = {
    "exp": _exp, "exp2": _exp2, "expm1": _expm1, "sinh": _sinh, "cosh": _cosh, "tanh": _tanh, "log": _log, "log1p": _log1p,
    "cbrt": _cbrt, "pow": _pow, "atan2": _atan2, "tan": _tan, "sin": _sin, "cos": _cos,
    "atan": lambda x: _atan2(x, constant(x, 1.0)), "asin": lambda x: _atan2(x, _cosine_of_arc(x)),
    "acos": lambda x: _atan2(_cosine_of_arc(x), x),
}  # fmt: skip

# The remainder is exact: a multiple of y by a power of two is taken away as long as there is one.
_FMOD = """define internal double @fmod(double %x, double %y) #0 {
entry:
  %a = call double @llvm.fabs.f64(double %x)
  %b = call double @llvm.fabs.f64(double %y)
  %finite = fcmp olt double %a, 0x7FF0000000000000
  %positive = fcmp ogt double %b, 0.0
  %possible = and i1 %finite, %positive
  br i1 %possible, label %up, label %none
none:
  ret double 0x7FF8000000000000
up:
  %m = phi double [ %b, %entry ], [ %twice, %double ]
  %half = fmul double %a, 0.5
  %is.small = fcmp ole double %m, %half
  br i1 %is.small, label %double, label %down
double:
  %twice = fmul double %m, 2.0
  br label %up
down:
  %r = phi double [ %a, %up ], [ %r.next, %halve ]
  %d = phi double [ %m, %up ], [ %d.next, %halve ]
  %is.less = fcmp olt double %r, %d
  %left = fsub double %r, %d
  %r.next = select i1 %is.less, double %r, double %left
  %is.last = fcmp ole double %d, %b
  br i1 %is.last, label %out, label %halve
halve:
  %d.next = fmul double %d, 0.5
  br label %down
out:
  %signed = call double @llvm.copysign.f64(double %r.next, double %x)
  ret double %signed
}"""


def library_text(name: str) -> str | None:
    """The text of a function of the C library and of what it calls; None where there is none of this name."""
    if name in FUNCTIONS or name == "fmod":
        return _text(name)
    base = name.removesuffix("f")
    if base not in FUNCTIONS and base != "fmod":
        return None
    names = ["%x", "%y"][: 2 if base in ("pow", "atan2", "fmod") else 1]
    lines = [f"  {x}.wide = fpext float {x} to double" for x in names]
    lines += [f"  %r.wide = call double @{base}({', '.join(f'double {x}.wide' for x in names)})"]
    lines += ["  %r = fptrunc double %r.wide to float", "  ret float %r", "}"]
    head = f"define internal float @{name}({', '.join(f'float {x}' for x in names)}) #0 {{"
    return "\n".join([head, *lines, _text(base)])


@functools.cache
def _text(name: str) -> str:
    if name == "fmod":
        declared = [
            f"declare double @llvm.{x}.f64({y})" for x, y in (("fabs", "double"), ("copysign", "double, double"))
        ]
        return "\n".join([_FMOD, *declared])
    e, names = Emitter(1), ["%x", "%y"][: 2 if name in ("pow", "atan2") else 1]
    result = FUNCTIONS[name](*(Number(e, x) for x in names)).name
    head = f"define internal double @{name}({', '.join(f'double {x}' for x in names)}) #0 {{"
    lines = [head, *e.lines, f"  ret double {result}", "}", *e.declared.values()]
    if any("@jaxdyn_two_over_pi" in line for line in e.lines):
        # A word of zeros and the first 1152 bits of 2/pi behind the point, more than float64's exponents and three words.
        size = 64 * 18
        value = (2 << 2 * size) // pi_with_bits(size)
        words = [0, *((value >> size - 64 * (k + 1)) & (2**64 - 1) for k in range(18)), 0, 0]
        data = ", ".join(f"i64 {w}" for w in words)
        lines.append(f"@jaxdyn_two_over_pi = private constant [{len(words)} x i64] [{data}]")
    return "\n".join(lines)
