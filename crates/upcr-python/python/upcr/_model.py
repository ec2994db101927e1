"""The network."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _upcr
from ._cloud import CloudLike, FloatArray, packed, read


class Model:
    """A trained UPCR network: the one in the package (:meth:`default`), or that of a weights file (:meth:`load`)."""

    def __init__(self, native: _upcr.Model) -> None:
        """Not to be called: a model comes from :meth:`default`, :meth:`load`, :meth:`from_bytes` or ``upcr.adapt``."""
        self._native = native

    @staticmethod
    def default() -> Model:
        """The network in the package."""
        return Model(_upcr.Model.default())

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Model:
        """The network of a weights file, as ``upcr train`` and :meth:`save` write it.

        Raises:
            OSError: The file cannot be read.
            FormatError: It is no weights file of this network.
        """
        return Model(_upcr.Model.load(os.fspath(path)))

    @staticmethod
    def from_bytes(weights: bytes) -> Model:
        """The network of a weights file's bytes."""
        return Model(_upcr.Model.from_bytes(weights))

    def to_bytes(self) -> bytes:
        """The weights file's bytes."""
        return self._native.to_bytes()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the weights file, whole or not at all."""
        self._native.save(os.fspath(path))

    def predict(self, source: CloudLike, target: CloudLike) -> FloatArray:
        """The pose that lays ``source`` on ``target``, shape (4, 4): one forward pass, nothing refined or verified.

        The clouds are meant to be as in training: of about a thousand points on the whole of a shape, in its unit
        sphere. ``upcr.register(source, target, method="upcr")`` takes clouds of any size and place.
        """
        return self._native.predict(_single(source), _single(target))

    @property
    def is_trained(self) -> bool:
        """Whether the weights were trained; random ones say so in their file."""
        return self._native.is_trained

    @property
    def fingerprint(self) -> str:
        """A number that tells weights apart, hexadecimal, as ``settings["network"]`` of a registration has it."""
        return self._native.fingerprint

    @property
    def config(self) -> dict[str, Any]:
        """What the network is made of."""
        return self._native.config

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Model) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def __reduce__(self) -> tuple[Callable[[bytes], Model], tuple[bytes]]:
        return Model.from_bytes, (self.to_bytes(),)

    def __repr__(self) -> str:
        widths = ", ".join(map(str, self.config["widths"]))
        trained = "trained" if self.is_trained else "not trained"
        return f"<upcr.Model {self.fingerprint}: {trained}, layers of {widths} channels>"


def _single(cloud: CloudLike) -> npt.NDArray[np.float32]:
    arrays = packed(cloud)
    points = read(arrays).points if isinstance(arrays, str) else arrays[0]
    return np.require(points, np.float32, ["C_CONTIGUOUS", "ALIGNED"])
