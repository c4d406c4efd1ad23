"""Lossless coder of tables of integers: adaptive frequencies, contexts chosen by the encoder, and range ANS.

A table has rows of equal length, one row for each attribute and one column for each splat (or sample). Rows are coded one
after the other, and a row can be conditioned on rows before it:

* Values become tokens and plain bits: up to `DIRECT` a value is its own token; above, a token has the number of bits and
  the two bits after the highest, and the others are stored as they are (as in JPEG XL, ISO/IEC 18181-1, C.2.3).
* Numbers have folded signs (0, -1, 1, -2, ... are 0, 1, 2, 3, ...). A row may be predicted, by the previous column or by an
  earlier row; then differences are coded.
* A token's frequencies are those seen so far in its context, which is the class of the same column in up to two earlier rows.
  Contexts with few values are blended with the frequencies of the whole row.
* Tokens are coded by interleaved range asymmetric numeral systems (J. Duda, arXiv 1311.2540; interleaving after F. Giesen,
  arXiv 1402.3392), one for each lane, so that numpy works on all lanes at once.

All computations that the decoder repeats are in integers or in single IEEE operations on float64, hence exact everywhere.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ....bench.contracts import FloatArray, IntArray

DIRECT = 32
"""Values below it are tokens themselves; a power of 2."""
_DIRECT_BITS = DIRECT.bit_length() - 1
TOKENS = DIRECT + 4 * (32 - _DIRECT_BITS)
PRECISION = 14
"""Bits of the frequencies of a context."""
LOW = 1 << 16
"""Lower limit of a lane's state; states have 32 bits."""
CLASSES = 6
"""Number of classes of an earlier row's values, by quantiles."""
MOST_LANES = 1024
LEAN = 12.0
"""Weight of the frequencies of the whole row in those of a context, in tokens."""
CANDIDATES = 10
"""Number of rows before a row that the encoder tries as its context, besides the first `FIRST`."""
FIRST = 8
SAMPLE = 1 << 14
"""Number of columns on which contexts are chosen."""


@dataclass(frozen=True)
class _Plan:
    """How a row is coded.

    ``predicted`` is 0 for no prediction, 1 for the previous column, and 2 + r for row r. ``given`` are contexts: 2 r for the
    classes of row r by value, and 2 r + 1 by magnitude. ``tokens`` is the number of tokens.
    """

    predicted: int
    given: tuple[int, ...]
    tokens: int


_ROW = struct.Struct("<HHHB")
_NONE = 0xFFFF
_HEAD = struct.Struct("<HII")


def encode(rows: Sequence[IntArray]) -> tuple[bytes, FloatArray]:
    """Code rows of whole numbers from 0 to 2^32 - 1, all of the same length.

    Returns
    -------
    bytes
        The stream; `decode` also needs the numbers of rows and columns.
    FloatArray
        (R,) bits that each row takes.
    """
    count = len(rows[0]) if len(rows) else 0
    lanes = _lanes(len(rows), count)
    known: list[IntArray] = []
    plans: list[_Plan] = []
    intervals: list[tuple[IntArray, IntArray]] = []
    flags: list[np.ndarray] = []
    bits: FloatArray = np.zeros(len(rows))
    before: FloatArray = np.zeros(0)
    classes = _Classes(known)
    for number, row in enumerate(rows):
        values = np.asarray(row, np.int64)
        plan, coded = _choose(values, known, classes)
        known.append(values)
        plans.append(plan)
        tokens, sizes, extra = _tokens(coded)
        context, contexts = classes.contexts(plan.given, count)
        model = _Model(contexts, plan.tokens, before)
        for start, stop, adapt in _batches(count, lanes):
            own, seen = context[start:stop], tokens[start:stop]
            low, width = model.intervals(own, seen)
            intervals.append((low, width))
            bits[number] += PRECISION * len(seen) - float(np.log2(width).sum())
            model.add(own, seen, now=adapt)
        before = model.shares
        flags += _planes(sizes, extra)
        bits[number] += int(sizes.sum()) + 8 * _ROW.size
    states = np.full(lanes, LOW, np.uint64)
    words: list[np.ndarray] = []
    shift = np.uint64(32 - PRECISION)
    for low, width in reversed(intervals):
        own, first, wide = states[: len(low)], low.astype(np.uint64), width.astype(np.uint64)
        full = own >= (wide << shift)
        words.append((own[full] & np.uint64(0xFFFF)).astype("<u2")[::-1])
        own = np.where(full, own >> np.uint64(16), own)
        states[: len(low)] = ((own // wide) << np.uint64(PRECISION)) + own % wide + first
    stream = np.concatenate(words)[::-1] if words else np.zeros(0, "<u2")
    plain = np.packbits(np.concatenate(flags)) if flags else np.zeros(0, np.uint8)
    head = _HEAD.pack(lanes, len(stream), len(plain))
    body = b"".join(_ROW.pack(plan.predicted, *_two(plan.given), plan.tokens - 1) for plan in plans)
    parts = (states.astype("<u4").tobytes(), stream.astype("<u2").tobytes(), plain.tobytes())
    return head + body + b"".join(parts), bits


def decode(stream: bytes, count: int, columns: int) -> list[IntArray]:
    """Inverse of `encode` for ``count`` rows. Raises ValueError for a damaged stream and for one of another table."""
    reader = _Reader(stream, count, columns)
    known: list[IntArray] = []
    classes = _Classes(known)
    for plan in reader.plans:
        known.append(reader.row(plan, known, classes))
    reader.close()
    return known


class _Reader:
    """State of a decoder."""

    def __init__(self, stream: bytes, count: int, columns: int):
        if len(stream) < _HEAD.size:
            raise ValueError("a stream without its head")
        lanes, words, plain = _HEAD.unpack_from(stream)
        size = _HEAD.size + count * _ROW.size + 4 * lanes + 2 * words + plain
        if lanes != _lanes(count, columns) or size != len(stream):
            raise ValueError(f"a stream of {len(stream)} bytes, and its head gives {size}, or of other lanes")
        self.plans = []
        for number in range(count):
            predicted, first, second, tokens = _ROW.unpack_from(stream, _HEAD.size + number * _ROW.size)
            given = tuple(value for value in (first, second) if value != _NONE)
            if predicted >= 2 + number or any(value >= 2 * number for value in given) or tokens >= TOKENS:
                raise ValueError("a row that depends on later rows, or has too many tokens")
            self.plans.append(_Plan(predicted, given, tokens + 1))
        place = _HEAD.size + count * _ROW.size
        self._states = np.frombuffer(stream, "<u4", lanes, place).astype(np.uint64)
        self._words = np.frombuffer(stream, "<u2", words, place + 4 * lanes).astype(np.uint64)
        rest = np.frombuffer(stream, np.uint8, plain, place + 4 * lanes + 2 * words)
        self._plain = np.unpackbits(rest)
        self._columns, self._word, self._flag = columns, 0, 0
        self._before: FloatArray = np.zeros(0)

    def row(self, plan: _Plan, known: Sequence[IntArray], classes: _Classes) -> IntArray:
        """The next row."""
        context, contexts = classes.contexts(plan.given, self._columns)
        model = _Model(contexts, plan.tokens, self._before)
        tokens = np.zeros(self._columns, np.int64)
        mask, shift = np.uint64((1 << PRECISION) - 1), np.uint64(PRECISION)
        for start, stop, adapt in _batches(self._columns, len(self._states)):
            own, states = context[start:stop], self._states[: stop - start]
            slots = states & mask
            found, low, width = model.find(own, slots.astype(np.int64))
            states = width.astype(np.uint64) * (states >> shift) + slots - low.astype(np.uint64)
            short = states < LOW
            needed = int(np.count_nonzero(short))
            words = self._words[self._word : self._word + needed]
            if len(words) != needed:
                raise ValueError("a stream that ends early")
            states[short] = (states[short] << np.uint64(16)) | words
            self._word += needed
            self._states[: stop - start] = states
            tokens[start:stop] = found
            model.add(own, found, now=adapt)
        self._before = model.shares
        values = self._values(tokens)
        if plan.predicted:
            signed = _unfolded(values)
            signed = (
                np.cumsum(signed) if plan.predicted == 1 else signed + _unfolded(known[plan.predicted - 2])
            )
            values = _folded(signed)
        if len(values) and not 0 <= int(values.min()) <= int(values.max()) < 2**32:
            raise ValueError("numbers beyond 32 bits")
        return values

    def close(self) -> None:
        """Check that the stream was read to its end."""
        if self._word != len(self._words) or (self._states != LOW).any() or len(self._plain) - self._flag > 7:
            raise ValueError("a damaged stream")

    def _values(self, tokens: IntArray) -> IntArray:
        base, sizes = _base_of(tokens)
        extra = np.zeros(len(tokens), np.int64)
        for bit in range(int(sizes.max(initial=0))):
            own = np.flatnonzero(sizes > bit)
            flags = self._plain[self._flag : self._flag + len(own)]
            if len(flags) != len(own):
                raise ValueError("a stream that ends early")
            extra[own] |= flags.astype(np.int64) << bit
            self._flag += len(own)
        return base + extra


class _Model:
    """Adaptive frequencies of a row's tokens by context; at first those of ``before``, (T,) shares of the tokens of the last row."""

    def __init__(self, contexts: int, tokens: int, before: FloatArray):
        self._counts = np.zeros((contexts, tokens))
        self._pending: list[IntArray] = []
        self._before = np.zeros(tokens)
        self._before[: len(before)] = before[:tokens]
        self._refresh()

    @property
    def shares(self) -> FloatArray:
        """(T,) shares of the tokens seen so far."""
        return self._counts.sum(0) / max(self._counts.sum(), 1.0)

    def intervals(self, context: IntArray, tokens: IntArray) -> tuple[IntArray, IntArray]:
        """Starts and widths of tokens, in units of 2^-`PRECISION`."""
        low = self._ends[context, tokens]
        return low, self._ends[context, tokens + 1] - low

    def find(self, context: IntArray, slots: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Tokens whose interval has a slot, with its start and width."""
        tokens = (self._ends[context, 1:] <= slots[:, None]).sum(1)
        return tokens, *self.intervals(context, tokens)

    def add(self, context: IntArray, tokens: IntArray, *, now: bool) -> None:
        """Count tokens; frequencies change where ``now`` is true."""
        self._pending.append(context * self._counts.shape[1] + tokens)
        if now:
            seen = np.bincount(np.concatenate(self._pending), minlength=self._counts.size)
            self._counts += seen.reshape(self._counts.shape)
            self._pending = []
            self._refresh()

    def _refresh(self) -> None:
        tokens = self._counts.shape[1]
        whole = self._counts.sum(0)
        whole = whole + LEAN * self._before + 0.05
        whole = whole / whole.sum()
        shares = self._counts + LEAN * whole
        total = self._counts.sum(1, keepdims=True) + LEAN
        widths = np.floor(shares / total * ((1 << PRECISION) - tokens - 1)).astype(np.int64) + 1
        rows = np.arange(len(widths))
        widths[rows, widths.argmax(1)] += (1 << PRECISION) - widths.sum(1)
        self._ends = np.zeros((len(widths), tokens + 1), np.int64)
        np.cumsum(widths, axis=1, out=self._ends[:, 1:])


class _Classes:
    """Classes of the values of earlier rows, computed once."""

    def __init__(self, rows: Sequence[IntArray]):
        self._rows = rows
        self._known: dict[int, tuple[IntArray, int]] = {}

    def __getitem__(self, given: int) -> tuple[IntArray, int]:
        """Class of each column, and the number of classes; see `_Plan.given`."""
        if given not in self._known:
            values = _unfolded(self._rows[given // 2])
            values = np.abs(values) if given % 2 else values
            ordered = np.sort(values)
            limits = ordered[np.arange(1, CLASSES) * len(ordered) // CLASSES] if len(ordered) else ordered
            # Limits are first values of a class. A value that would fill several classes gets a separate class.
            limits = np.unique(np.concatenate([limits, limits + 1]))
            found = np.searchsorted(limits, values, side="right")
            names, found = np.unique(found, return_inverse=True)
            self._known[given] = found.astype(np.int64).reshape(-1), max(len(names), 1)
        return self._known[given]

    def contexts(self, given: Sequence[int], columns: int) -> tuple[IntArray, int]:
        """Context of each column, and the number of contexts."""
        context, total = np.zeros(columns, np.int64), 1
        for each in given:
            found, size = self[each]
            context, total = context * size + found, total * size
        return context, total


def _choose(values: IntArray, known: Sequence[IntArray], classes: _Classes) -> tuple[_Plan, IntArray]:
    """The cheapest plan of a row, and the folded numbers to code."""
    stride = max(1, len(values) // SAMPLE)
    options = {0: values}
    if len(values) > 1:
        signed = _unfolded(values)
        options[1] = _folded(np.diff(signed, prepend=0))
        options |= {
            2 + r: _folded(signed - _unfolded(known[r])) for r in range(max(0, len(known) - 3), len(known))
        }
    options = {key: each for key, each in options.items() if int(each.max(initial=0)) < 2**32}
    costs = {
        key: _bits(_tokens(each[::stride]), np.zeros(len(each[::stride]), np.int64), 1)
        for key, each in options.items()
    }
    predicted = min(costs, key=lambda key: (costs[key], key))
    coded = options[predicted]
    tokens = _tokens(coded)
    sampled = tokens[0][::stride], tokens[1][::stride], tokens[2][::stride]
    best = costs[predicted]
    given: tuple[int, ...] = ()
    near = sorted({*range(min(FIRST, len(known))), *range(max(0, len(known) - CANDIDATES), len(known))})
    for _ in range(2):
        found = {}
        for each in (2 * row + kind for row in near for kind in (0, 1)):
            context, total = classes.contexts((*given, each), len(values))
            if total > 1:
                found[each] = _bits(sampled, context[::stride], total)
        if not found:
            break
        first = min(found, key=lambda key: (found[key], key))
        if found[first] >= 0.995 * best:
            break
        best, given = found[first], (*given, first)
    return _Plan(predicted, given, int(tokens[0].max(initial=0)) + 1), coded


def _bits(tokens: tuple[IntArray, IntArray, IntArray], context: IntArray, contexts: int) -> float:
    """Bits of tokens under their contexts, with the cost of learning frequencies."""
    size = int(tokens[0].max(initial=0)) + 1
    counts = np.bincount(context * size + tokens[0], minlength=contexts * size).reshape(contexts, size)
    totals = counts.sum(1)
    logs = (totals * np.log2(np.maximum(totals, 1))).sum() - (counts * np.log2(np.maximum(counts, 1))).sum()
    learning = 3.0 * np.count_nonzero(counts)
    return float(logs + learning + tokens[1].sum())


def _lanes(rows: int, columns: int) -> int:
    return int(np.clip(rows * columns // 2048, 1, MOST_LANES)) if columns else 1


def _batches(columns: int, lanes: int) -> Iterator[tuple[int, int, bool]]:
    """First and last column of each batch, and whether frequencies change after it: often at first, then every 4096 columns."""
    learned, start = 0, 0
    while start < columns:
        stop = min(start + min(lanes, max(16, start)), columns)
        adapt = stop - learned >= min(4096, learned)
        learned = stop if adapt else learned
        yield start, stop, adapt
        start = stop


def _two(given: tuple[int, ...]) -> tuple[int, int]:
    padded = (*given, _NONE, _NONE)
    return padded[0], padded[1]


def _folded(values: IntArray) -> IntArray:
    """0, -1, 1, -2, ... as 0, 1, 2, 3, ..."""
    return np.where(values < 0, -2 * values - 1, 2 * values)


def _unfolded(values: IntArray) -> IntArray:
    return np.where(values % 2 == 1, -(values + 1) // 2, values // 2)


def _tokens(values: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Tokens, numbers of plain bits, and plain bits."""
    length = np.frexp(np.maximum(values, 1).astype(np.float64))[1].astype(np.int64)
    sizes = np.where(values < DIRECT, 0, length - 3)
    high = values >> sizes  # 4 to 7
    tokens = np.where(values < DIRECT, values, DIRECT + 4 * (length - _DIRECT_BITS - 1) + high - 4)
    return tokens, sizes, values - (high << sizes)


def _base_of(tokens: IntArray) -> tuple[IntArray, IntArray]:
    """Smallest value of a token, and the number of its plain bits."""
    above = tokens - DIRECT
    sizes = np.where(above < 0, 0, above // 4 + _DIRECT_BITS - 2)
    return np.where(above < 0, tokens, (4 + above % 4) << sizes), sizes


def _planes(sizes: IntArray, extra: IntArray) -> list[np.ndarray]:
    """Plain bits, the lowest of all values first."""
    top = int(sizes.max(initial=0))
    return [((extra[sizes > bit] >> bit) & 1).astype(np.uint8) for bit in range(top)]
