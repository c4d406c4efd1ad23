"""Messages between a run and the process of a method: what arrives is what was sent, or an error."""

import json
import threading
from multiprocessing import Pipe

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from headbench.bench.errors import HeadbenchError
from headbench.bench.isolation.messages import receive, send

KINDS = ["uint8", "bool", "float32", "float64", "int32", "int64"]


def exchanged(*sent):
    """What is received of messages as bytes."""
    first, second = Pipe()

    def write():
        try:
            for data in sent:
                first.send_bytes(data)
        except OSError:
            pass  # the other side has refused the message
        first.close()

    thread = threading.Thread(target=write)
    thread.start()
    try:
        return receive(second)
    finally:
        second.close()
        thread.join()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", [(2, 3), (0, 4), (), (1, 2, 3, 4)])
def test_arrays_arrive_as_sent_and_read_only(kind, shape):
    first, second = Pipe()
    array = (np.arange(np.prod(shape, dtype=int)) % 2).astype(kind).reshape(shape)
    send(first, {"done": 1}, {"x": array, "turned": array.T})
    message, found = receive(second)
    assert message == {"done": 1}
    for name, expected in {"x": array, "turned": array.T}.items():
        np.testing.assert_array_equal(found[name], expected)
        assert found[name].dtype == expected.dtype
        with pytest.raises(ValueError, match="WRITEABLE"):
            found[name].flags.writeable = True


@pytest.mark.parametrize(
    "sent",
    [
        [b"cos\nsystem\n(S'true'\ntR."],
        [b"[" * 100_000],
        [b'{"done": 1}'],
        [b"[1, {}]"],
        [b'[{}, {"x": ["object", [1]]}]', b"12345678"],
        [b'[{}, {"x": ["float32", [2]]}]', b"1234"],
        [b'[{}, {"x": ["float32", [1]]}]', b"12345678"],
        [b'[{}, {"x": ["float32", [-1]]}]'],
        [b'[{}, {"x": ["float32", [2147483647, 2147483647]]}]'],
        [b'[{}, {"x": ["float32", [true]]}]', b"1234"],
        [b"x" * (1 << 25)],
    ],
    ids=lambda sent: sent[0][:30].decode(),
)
def test_anything_else_is_refused(sent):
    with pytest.raises(HeadbenchError, match="the process of the method sent"):
        exchanged(*sent)


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda each: st.lists(each) | st.dictionaries(st.text(), each),
)


@given(
    st.lists(
        st.binary(max_size=64) | _VALUES.map(lambda value: json.dumps(value).encode()), min_size=1, max_size=3
    )
)
def test_damaged_messages_are_errors(sent):
    try:
        message, _ = exchanged(*sent)
        assert isinstance(message, dict)
    except (HeadbenchError, EOFError):
        pass
