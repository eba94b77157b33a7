"""Networks in the format ONNX: fetched, checked and run by onnxruntime."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from numpy import ndarray

from gscompleter.cpu_threads import get_thread_count
from gscompleter.errors import InputError
from gscompleter.models.weights.published import PublishedWeights
from gscompleter.models.weights.reading import fetch_checked

INSTALL = "pip install 'gscompleter[onnx]'"
ADVICE = "check that the file is the published one, or choose another generator"

Signature = Mapping[str, tuple[str, int]]
"""Type and number of channels of each input, by its name."""


class OnnxNetwork:
    """A network from an image and a mask to an image of the same size."""

    def __init__(self, session: Any) -> None:
        self.session = session

    @property
    def fixed_size(self) -> tuple[int, int] | None:
        """Height and width that the network accepts, or None for any."""
        height, width = (*self.session.get_inputs()[0].shape, None, None)[2:4]
        return (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def __call__(self, image: ndarray, mask: ndarray) -> ndarray:
        """Run the network on arrays of shape [1, c, h, w]; raise InputError if it fails."""
        try:
            (result,) = self.session.run(None, {"image": image, "mask": mask})
        except Exception as error:  # onnxruntime has an error class per status code
            raise InputError(f"The network failed on an image; {ADVICE}.") from error
        if result.shape != image.shape:
            raise InputError(
                f"The network answered an image of shape {image.shape} by {result.shape}; {ADVICE}."
            )
        return result


def load_network(
    weights: PublishedWeights, signature: Signature, file: str | None, device: str
) -> OnnxNetwork:
    """Load the published network, or a file of the same signature.

    Raises:
        InputError: onnxruntime or the file is missing, or the file is not such a network.
        WeightsNotAvailable: The published file is not local and cannot be downloaded.
    """
    if find_spec("onnxruntime") is None:
        raise InputError(
            f"The generator {weights.name!r} needs onnxruntime: {INSTALL}.", "generator"
        )
    path = fetch_checked(weights, None if file is None else Path(file))
    session = open_session(path, device)
    given = {x.name: (x.type, x.shape[1]) for x in session.get_inputs() if len(x.shape) == 4}
    network = OnnxNetwork(session)
    fits = given == dict(signature) and network.fixed_size in (None, weights.image_size)
    if not fits or len(session.get_outputs()) != 1:
        found = ", ".join(f"{x.name} {x.type} {x.shape}" for x in session.get_inputs())
        raise InputError(
            f"{path} is no {weights.model} network: its inputs are {found}; give {weights.file} "
            f"from {weights.source}.",
            "generator_weights",
        )
    return network


def open_session(path: Path, device: str) -> Any:
    """Open an ONNX file, with the same result in every run on one machine."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = get_thread_count()
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    wanted = ["CUDAExecutionProvider"] if device == "cuda" else []
    usable = [name for name in wanted if name in onnxruntime.get_available_providers()]
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=[*usable, "CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime has an error class per status code
        raise InputError(
            f"{path} cannot be read as an ONNX network: it is damaged or of another format.",
            "generator_weights",
        ) from error
