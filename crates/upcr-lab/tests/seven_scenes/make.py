"""Writes depth.png: `python make.py`, with Pillow. Depths are 0, 1002, 1003, … 1048 mm."""

import numpy as np
from PIL import Image

depth = np.arange(1001, 1049, dtype=np.uint16).reshape(6, 8)
depth[0, 0] = 0
Image.fromarray(depth).save("depth.png")
