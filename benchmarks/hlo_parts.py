"""Tells from a compiled module which part of a plan each of its operations belongs to.

A compiled operation carries the Python functions it came from, so its part is found by the
innermost function that a rule knows. A fusion holds operations of several parts; its time is
split between them by an estimate: elements times a weight per kind of operation. Only that
split is estimated.
"""

import collections
import dataclasses
import math
import re
from collections.abc import Iterator

PRODUCTS = "matrix products"
ACTIVATION = "activation and bias"
NOISE = "drawing noise and candidates"
SAMPLING = "variance and sample of the delta"
TASK = "task functions"
SEARCH = "ranking and elites"
ROLLOUT = "rollout: copies, casts, sums"
BEFORE = "context, heads, folding"
OTHER = "other"

# (file, function, part): the first line whose texts occur in a frame decides.
RULES = (
    ("headway/envs/", "", TASK),
    ("headway/task.py", "", TASK),
    ("planning/noise.py", "", NOISE),
    ("headway/", "noise", NOISE),
    ("headway/", "draw", NOISE),
    ("models/networks.py", "swish", ACTIVATION),
    ("models/networks.py", "Dense.__call__", ACTIVATION),
    ("models/networks.py", "bound_logvar", SAMPLING),
    ("planning/imagination.py", "Layer.__call__", ACTIVATION),
    ("models.networks.py", "", ACTIVATION),
    ("planning/imagination.py", "rough_swish", ACTIVATION),
    ("planning/imagination.py", "fold", BEFORE),
    ("planning/imagination.py", "", SAMPLING),
    ("planning/returns.py", "", ROLLOUT),
    ("planning/devices.py", "", ROLLOUT),
    ("planning/optimizers/", "", SEARCH),
    ("headway/", "", BEFORE),
)
RANDOM = re.compile(r"threefry|random|erf_inv|jit\(_?(normal|uniform|truncated_normal|randint)")
PRODUCT_CALL = re.compile(r"gemm|matmul|dot", re.IGNORECASE)
CONTAINERS = {"while", "call", "conditional"}
FREE = {"parameter", "constant", "broadcast", "bitcast", "reshape", "tuple", "get-tuple-element"}
# Time per element, an addition being 1; measured with chains of eight on one core of a CPU.
WEIGHTS = {
    "exponential": 30.0, "exponential-minus-one": 40.0, "log": 30.0, "log-plus-one": 45.0,
    "logistic": 35.0, "tanh": 25.0, "sine": 55.0, "cosine": 55.0, "power": 280.0, "sqrt": 4.0,
    "rsqrt": 4.0, "divide": 4.0,
}  # fmt: skip

_COMPUTATION = re.compile(r"^(?:ENTRY )?%([\w.-]+) \(.*\{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%([\w.-]+) = (\(.*?\)|\S+) ([a-z][a-z0-9-]*)\(")
_SHAPE = re.compile(r"([a-z0-9]+)\[([\d,]*)\]")
_CALLED = re.compile(r"(?:calls|body|to_apply|called_computations)=\{?%([\w.-]+)")
_TABLE_ROW = re.compile(r"^(\d+) (?:\"(.*)\"|\{(.*)\})$")


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One line of a module's text."""

    name: str
    opcode: str
    elements: int
    op_name: str
    frame: int
    called: str
    line: str

    @classmethod
    def parse(cls, line: str) -> "Instruction | None":
        """Read a line; None if it is no instruction."""
        found = _INSTRUCTION.match(line)
        if found is None:
            return None
        name, shape, opcode = found.groups()
        sizes = [
            math.prod(int(n) for n in dims.split(",") if n) for _, dims in _SHAPE.findall(shape)
        ]
        op_name = re.search(r'op_name="([^"]*)"', line)
        frame = re.search(r"stack_frame_id=(\d+)", line)
        called = _CALLED.search(line)
        return cls(
            name,
            opcode,
            max(sizes, default=0),
            op_name[1] if op_name else "",
            int(frame[1]) if frame else 0,
            called[1] if called else "",
            line,
        )

    @property
    def is_product(self) -> bool:
        """Whether this is a matrix product, or a call to a library's."""
        if self.opcode == "custom-call":
            target = re.search(r'custom_call_target="([^"]*)"', self.line)
            return bool(target and PRODUCT_CALL.search(target[1]))
        return self.opcode in ("dot", "convolution")


class Module:
    """A compiled module, read from its text."""

    def __init__(self, text: str):
        self.computations: dict[str, list[Instruction]] = {}
        self._tables: dict[str, dict[int, str]] = collections.defaultdict(dict)
        title, body = "", []
        for line in text.splitlines():
            if header := _COMPUTATION.match(line):
                body = self.computations.setdefault(header[1], [])
            elif row := _TABLE_ROW.match(line):
                self._tables[title][int(row[1])] = row[2] or row[3]
            elif instruction := Instruction.parse(line):
                body.append(instruction)
            elif line.isalpha():
                title = line

    def operations(self) -> Iterator[tuple[Instruction, dict[str, float]]]:
        """Every operation that may run by itself, with the shares of its parts."""
        fused = {
            i.called for body in self.computations.values() for i in body if i.opcode == "fusion"
        }
        around = self._loops()
        for name, body in self.computations.items():
            if name not in fused:
                for instruction in body:
                    yield instruction, self._shares(instruction, around.get(name, OTHER))

    def _loops(self) -> dict[str, str]:
        """The part of the loop or call that runs a computation."""
        return {
            i.called: self._part(i, OTHER)
            for body in self.computations.values()
            for i in body
            if i.opcode in CONTAINERS
        }

    def _shares(self, instruction: Instruction, around: str) -> dict[str, float]:
        """How an operation's time is split over parts; the shares sum to 1."""
        if instruction.opcode != "fusion":
            return {self._part(instruction, around): 1.0}
        fused = self.computations[instruction.called]
        if any(one.is_product for one in fused):
            return {PRODUCTS: 1.0}
        weights: dict[str, float] = collections.defaultdict(float)
        known = self._part(instruction, around)
        for one in fused:
            if one.opcode not in FREE:
                weights[self._part(one, known)] += one.elements * WEIGHTS.get(one.opcode, 1.0)
        total = sum(weights.values())
        return {part: w / total for part, w in weights.items()} if total else {known: 1.0}

    def _part(self, instruction: Instruction, around: str) -> str:
        """The part of one operation; `around` where nothing is known of it."""
        if instruction.is_product:
            return PRODUCTS
        if RANDOM.search(instruction.op_name):
            return NOISE
        for path, function in self._stack(instruction.frame):
            for file_text, function_text, part in RULES:
                if file_text in path and function_text in function:
                    return part
        return around

    def _stack(self, frame: int) -> Iterator[tuple[str, str]]:
        """File and function of a frame and of its callers, innermost first."""
        while frame > 0:
            fields = _numbers(self._tables["StackFrames"].get(frame, ""))
            location = _numbers(self._tables["FileLocations"].get(fields["file_location_id"], ""))
            yield (
                self._tables["FileNames"].get(location["file_name_id"], ""),
                self._tables["FunctionNames"].get(location["function_name_id"], ""),
            )
            frame = fields["parent_frame_id"] - 1  # counted from 1, 1 being none


def _numbers(text: str) -> dict[str, int]:
    """Read `a=1 b=2`; what is missing is 0."""
    pairs = re.findall(r"(\w+)=(\d+)", text)
    return collections.defaultdict(int, {key: int(value) for key, value in pairs})
