"""Networks in the format ONNX: fetched, checked and run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from numpy import ndarray

from gscompleter.models.weights.published import PublishedWeights
from gscompleter.models.weights.reading import fetch_checked
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.threads import get_thread_count

INSTALL = "pip install 'gscompleter[onnx]'"
ADVICE = "check that the file is the published one, or choose another model"

Signature = Mapping[str, tuple[str, int | None]]
"""Type of each input and its number of channels, or None for a number, by its name."""


class OnnxNetwork:
    """A network that reads an image, and perhaps more."""

    def __init__(self, session: Any) -> None:
        self.session = session

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """Height and width that the network accepts; None if either is free."""
        # Images have the shape [1, c, h, w]; a side is text or None if it is free.
        height, width = (*self.session.get_inputs()[0].shape, None, None)[2:4]
        return (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def __call__(self, **inputs: ndarray) -> list[ndarray]:
        """Run the network on `inputs` by name; return its outputs in the order of the file.

        Images have the shape [1, c, h, w] and the type and range that the caller's model asks for.
        Raise InputError if it fails.
        """
        try:
            return list(self.session.run(None, inputs))
        except Exception as error:  # onnxruntime has an error class per status code
            raise InputError(f"The network failed on an image; {ADVICE}.") from error


def load_network(
    weights: PublishedWeights,
    signature: Signature,
    file: Path | str | None,
    device: str,
    option: str = "generator_weights",
    num_outputs: int = 1,
) -> OnnxNetwork:
    """Load the published network, or a file of the same signature that the user named by `option`.

    The file has exactly the inputs of `signature` and `num_outputs` outputs, and if it fixes the
    size of its images, that is `weights.image_size`. On `cuda` it runs on the GPU if onnxruntime
    can, and on the CPU else.

    Raises:
        InputError: onnxruntime or the file is missing, or the file is not such a network.
        WeightsNotAvailable: The published file is not local and cannot be downloaded.
    """
    if find_spec("onnxruntime") is None:
        raise InputError(f"The model {weights.name!r} needs onnxruntime: {INSTALL}.")
    path = fetch_checked(weights, None if file is None else Path(file))
    session = open_session(path, device, option)
    inputs = session.get_inputs()
    own_signature = {x.name: (x.type, x.shape[1] if len(x.shape) == 4 else None) for x in inputs}
    network = OnnxNetwork(session)
    fits = own_signature == dict(signature) and network.fixed_size in (None, weights.image_size)
    if not fits or len(session.get_outputs()) != num_outputs:
        listed = ", ".join(f"{x.name} {x.type} {x.shape}" for x in inputs)
        raise InputError(
            f"{quote_value(path)} is no {weights.model} network: its inputs are {listed}; give "
            f"{weights.file} from {weights.source}.",
            option,
        )
    return network


def open_session(path: Path, device: str, option: str) -> Any:
    """Open an ONNX file, with the same result in every run on one machine."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = get_thread_count()
    options.use_deterministic_compute = True
    # Only fatal messages: failures become an InputError with advice.
    options.log_severity_level = 4
    # A GPU is used if onnxruntime was built for one, and a CPU otherwise.
    wanted = ["CUDAExecutionProvider"] if device == "cuda" else []
    usable = [name for name in wanted if name in onnxruntime.get_available_providers()]
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=[*usable, "CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime has an error class per status code
        raise InputError(
            f"{quote_value(path)} cannot be read as an ONNX network: it is damaged or of another "
            "format.",
            option,
        ) from error
