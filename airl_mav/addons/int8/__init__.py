"""Policies in 8-bit integers: calibrated with frames of their own flights, compared with floats.

Command: `airl export POLICY --int8`. From Python: `int8.quantisation.export_int8`.
Depends on: the vectorized simulator (`airl_mav.envs`), ONNX Runtime and onnx (extra `profile`).
Guide: docs/how-to/trained-model.md.
"""

EXPORTS = {"int8": "airl_mav.addons.int8.quantisation:export_int8"}
