"""More than one machine: many pairs, and adaptation, on a Ray cluster (``pip install upcr[ray]``).

>>> import upcr.ray
>>> pairs = upcr.ray.read_pairs("pairs.parquet")  # doctest: +SKIP
>>> upcr.ray.register_pairs(pairs).write_parquet("poses")  # doctest: +SKIP

Ray moves the data, restarts what dies and tries again; each pair's result is what :func:`upcr.register` finds on one
machine, to the last bit.
"""

try:
    import ray.data as _data  # noqa: F401
except ImportError as error:
    raise ImportError(f'{error}: upcr.ray needs Ray and Arrow, pip install "upcr[ray]"') from error

from ._adapt import adapt
from ._pairs import SCHEMA, Registrar, read_pairs, register_pairs

__all__ = ["SCHEMA", "Registrar", "adapt", "read_pairs", "register_pairs"]
