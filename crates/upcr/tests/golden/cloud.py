"""Writes cloud.txt: 150 points of a bumpy torus with slightly disturbed normals, `x y z nx ny nz` a line."""

import numpy as np

rng = np.random.default_rng(7)
u, v = rng.uniform(0, 2 * np.pi, (2, 150))


def surface(u, v):
    r = 0.4 + 0.05 * np.sin(5 * u) * np.cos(3 * v)
    return np.stack([(1 + r * np.cos(v)) * np.cos(u), (1 + r * np.cos(v)) * np.sin(u), r * np.sin(v)], axis=1)


h = 1e-5
du = surface(u + h, v) - surface(u - h, v)
dv = surface(u, v + h) - surface(u, v - h)
normals = np.cross(du, dv)
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
normals += rng.normal(0, 0.1, normals.shape)
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
np.savetxt("cloud.txt", np.hstack([surface(u, v), normals]).astype(np.float32), fmt="%.9g")
