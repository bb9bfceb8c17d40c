"""Sine and cosine of an angle at once, for the equations of plants.

What is here is compiled into the equations; a call of the C library's would keep LLVM from making vectors of those of many
points at once. It is right to 1.6e-16, and the same on every processor.

The algorithm is fdlibm's (Sun Microsystems, 1993, s_sin.c, k_sin.c, k_cos.c; its coefficients): the angle less a multiple
of pi/2, in three parts (Cody and Waite), then a polynomial for each of the two.
"""

from __future__ import annotations

import numpy as np

from fdi_gym.kernels import inlined

EIGHTH = np.pi / 4
PER_QUARTER = 6.36619772367581382433e-01  # 2 / pi
QUARTER = 1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21  # 33 + 33 + 53 bits of pi / 2
S1, S2, S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
S4, S5, S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
C1, C2, C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
C4, C5, C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@inlined
def sincos(x):
    """(sin x, cos x) of an angle x [rad]; kernels of plants may call it.

    Each is within 1.6e-16 of the true one up to 1e5 rad; beyond, of that of an angle as near as x's own rounding. It has no
    call and no loop, so that LLVM can make vectors of what it is in.
    """
    n, r = 0.0, x
    if abs(x) > EIGHTH:
        n = np.rint(x * PER_QUARTER)
        r = ((x - n * QUARTER[0]) - n * QUARTER[1]) - n * QUARTER[2]
        r = 1.0 if r > 1.0 else r  # x is so large that no digit of its angle is known
        r = -1.0 if r < -1.0 else r
    z = r * r
    z2 = z * z
    half, w = 0.5 * z, 1.0 - 0.5 * z
    s = r + r * z * ((S1 + z * S2) + z2 * ((S3 + z * S4) + z2 * (S5 + z * S6)))  # in pairs (Estrin)
    c = w + (((1.0 - w) - half) + z2 * ((C1 + z * C2) + z2 * ((C3 + z * C4) + z2 * (C5 + z * C6))))
    quarter = n - 4.0 * np.floor(0.25 * n)
    a, b = (c, s) if quarter == 1.0 or quarter == 3.0 else (s, c)
    return (-a if quarter >= 2.0 else a), (-b if quarter == 1.0 or quarter == 2.0 else b)
