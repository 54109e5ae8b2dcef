#!/bin/sh
# onnxruntime 1.32.0: a session asked for an execution provider that does not exist is made all the same, on the CPU.
#
# Behaviour: InferenceSession(model, providers=["TensorRTExecutionProvider"]) (rightly: TensorrtExecutionProvider) raises
# nothing. Its Python wrapper catches the error, *prints* four lines to standard output, and makes a session on the CPU
# instead. Options of the wrong length go the same way: they are dropped. With `enable_fallback=0`, an argument that stands in
# no signature, both raise.
# Why it matters: a policy that is said to run on an accelerator runs on the CPU, at another latency and with other rounding;
# and a program whose standard output is read by another one, e.g. JSON lines, breaks on text that it never printed.
# A good guess: an unknown provider is an error, as the engine below says; notes of a library go to logging or stderr.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q onnxruntime==1.32.0 onnx==1.23.2
"$folder/venv/bin/python" - 2> /dev/null <<'PY'
import contextlib
import io

import onnxruntime
from onnx import TensorProto, helper

value = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]) for name in "xy"]
graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "g", value[:1], value[1:])
model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8).SerializeToString()


def made(**options):
    """Providers of the session, or the error; and what was printed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        try:
            found = onnxruntime.InferenceSession(model, **options).get_providers()
        except (RuntimeError, ValueError) as error:
            found = str(error)
    return found, said.getvalue().splitlines()


misspelt = {"providers": ["TensorRTExecutionProvider"]}
uneven = {"providers": ["CPUExecutionProvider"], "provider_options": [{}, {}]}
for options in (misspelt, uneven, misspelt | {"enable_fallback": 0}, uneven | {"enable_fallback": 0}):
    found, said = made(**options)
    print(options, "->", found, "| printed:", said[1:3])
assert made(**misspelt)[0] == made(**uneven)[0] == ["CPUExecutionProvider"], "this has changed"
assert len(made(**misspelt)[1]) == 4, "this has changed"
assert "Unknown Provider Type" in made(**misspelt, enable_fallback=0)[0], "this has changed"
assert "same length" in made(**uneven, enable_fallback=0)[0], "this has changed"
PY
# Seen (shortened):
# {'providers': ['TensorRTExecutionProvider']} -> ['CPUExecutionProvider'] | printed: ['EP Error Unknown Provider Type: ...
# {'providers': ['CPUExecutionProvider'], 'provider_options': [{}, {}]} -> ['CPUExecutionProvider'] | printed: ["EP Error ...
# {..., 'enable_fallback': 0} -> Unknown Provider Type: TensorRTExecutionProvider | printed: []
# {..., 'enable_fallback': 0} -> 'providers' and 'provider_options' should be the same length if both are given. | printed: []
