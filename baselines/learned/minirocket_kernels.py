"""MiniRocket's convolutions, compiled: the share of positive values of each kernel, dilation, and bias.

A. Dempster, D. F. Schmidt, G. I. Webb, Proceedings of KDD 2021. A kernel has nine weights, six of -1 and three of 2.
"""

from __future__ import annotations

from numba import boolean, float64, int64, void

from fdi_gym.estimation.compiled import helper
from fdi_gym.kernels import M, compiled, floats

I1, I2, B2, M3 = int64[::1], int64[:, ::1], boolean[:, ::1], float64[:, :, ::1]
WEIGHTS = 9


@helper
def convolved(x, dilation, triple, channels, total, out):
    """out[t] = the kernel's convolution of total, the sum of the chosen channels of x (channels, L), 0 beyond its ends."""
    many, L = x.shape
    for t in range(L):
        total[t] = 0.0
        out[t] = 0.0
    for c in range(many):
        if channels[c]:
            for t in range(L):
                total[t] += x[c, t]
    for j in range(WEIGHTS):
        weight = 2.0 if j == triple[0] or j == triple[1] or j == triple[2] else -1.0
        shift = (j - WEIGHTS // 2) * dilation
        for t in range(max(0, -shift), min(L, L - shift)):
            out[t] += weight * total[t + shift]


@compiled(void(M3, I1, I2, B2, M, M))
def transform(x, dilations, triples, channels, bias, out):
    """out[n, f] for windows x (n, channels, L).

    Feature f = ((d * kernels) + k) * biases + b is the share of the values of kernel k (triples[k]) at dilations[d], over
    the channels of pair d * kernels + k, that are above bias[pair, b]. Every other pair leaves out the values that reach
    beyond the window's ends.
    """
    n, _, L = x.shape
    kernels, biases = len(triples), bias.shape[1]
    total, value = floats(L), floats(L)
    for i in range(n):
        for d in range(len(dilations)):
            edge = WEIGHTS // 2 * dilations[d]
            for k in range(kernels):
                pair = d * kernels + k
                convolved(x[i], dilations[d], triples[k], channels[pair], total, value)
                first = edge if (d + k) % 2 else 0
                for b in range(biases):
                    above = 0
                    for t in range(first, L - first):
                        if value[t] > bias[pair, b]:
                            above += 1
                    out[i, pair * biases + b] = above / (L - 2 * first)


@compiled(void(M3, I1, I2, B2, M3))
def values(x, dilations, triples, channels, out):
    """The convolutions themselves, of window i: out[i, pair, t]."""
    n, _, L = x.shape
    total = floats(L)
    for i in range(n):
        for d in range(len(dilations)):
            for k in range(len(triples)):
                pair = d * len(triples) + k
                convolved(x[i], dilations[d], triples[k], channels[pair], total, out[i, pair])
