"""Writes the HDF5 files of this folder: `python make.py`, with h5py 3.16.

Element i of every dataset, counted in row-major order, is i / 4 - 3, or i where the numbers are integers.
"""

import h5py
import numpy as np


def count(shape, dtype):
    values = np.arange(np.prod(shape)).reshape(shape)
    return values.astype(dtype) if np.issubdtype(dtype, np.integer) else (values / 4 - 3).astype(dtype)


# Superblock 0, symbol tables: as the published ModelNet40. Chunks overhang the edges.
with h5py.File("earliest.h5", "w", libver="earliest") as file:
    file.create_dataset("data", data=count((7, 5, 3), "<f4"), chunks=(2, 3, 2), compression="gzip", shuffle=True)
    file.create_dataset("label", data=count((7, 1), "u1"))
    # More chunks than one node of the tree holds.
    file.create_dataset("gzip", data=count((100, 3), ">f8"), chunks=(1, 3), compression="gzip")
    file.create_dataset("plain", data=count((9,), "<i2"), chunks=(4,))
    file.create_dataset("checked", data=count((9,), "<i8"), chunks=(4,), fletcher32=True)
    file.create_dataset("text", data=b"words")
    file["data"].attrs["about"] = "x" * 600  # a header that continues elsewhere
    for i in range(20):  # more names than one node of symbols holds
        file.create_dataset(f"other{i:02}", data=np.int32(i))

# Superblock 3, links in the header.
with h5py.File("latest.h5", "w", libver="latest") as file:
    file.create_dataset("data", data=count((4, 3), ">f8"))
    file.create_dataset("label", data=count((4, 1), "<i4"))
    file.create_dataset("chunked", data=count((4, 3), "<f4"), chunks=(2, 3), compression="gzip")
