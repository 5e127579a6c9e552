"""Lines of JSON-RPC."""

import io
import json
import math
import threading

from hypothesis import given
from hypothesis import strategies as st
from primdiffusion.serve import RpcError, RpcRequest, Wire, parse_request
from support.errors import refused

scalars = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
anything = st.recursive(scalars, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=10)
requests = st.fixed_dictionaries({}, optional={name: anything for name in ("jsonrpc", "id", "method", "params")}).map(
    lambda message: {**message, "jsonrpc": "2.0"} if len(message) % 2 else message
)


@given(
    st.binary()
    | anything.map(lambda value: json.dumps(value).encode())
    | requests.map(lambda r: json.dumps(r).encode())
)
def test_any_line_is_a_request_or_an_error_that_can_be_sent(line):
    stream = io.BytesIO()
    try:
        request = parse_request(line)
    except RpcError as e:
        Wire(stream).fail(e.id, e)
    else:
        assert isinstance(request, RpcRequest)
        Wire(stream).respond(request.id, request.method)
    assert stream.getvalue().count(b"\n") == 1
    assert "id" in json.loads(stream.getvalue())


def test_lines_of_many_threads_do_not_mix_and_nan_is_not_sent():
    stream = io.BytesIO()
    wire = Wire(stream)
    threads = [
        threading.Thread(target=lambda i=i: [wire.notify("n", thread=i, text="x" * 5000) for _ in range(50)])
        for i in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 400
    assert sorted(json.loads(line)["params"]["thread"] for line in lines) == sorted(list(range(8)) * 50)
    with refused(ValueError, "JSON"):
        wire.notify("n", value=math.nan)
    assert len(stream.getvalue().splitlines()) == 400
