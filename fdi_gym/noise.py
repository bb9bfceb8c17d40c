"""White noise by counter: the normals of a sample are a function of the flight's seed, the sample and the channel alone.

Nothing is stored and nothing is drawn in an order, so chunks, batches, threads, restarts and pickling give the same
bytes. The generator is Philox4x32-10 (J. K. Salmon, M. A. Moraes, R. O. Dror, D. E. Shaw, Parallel random numbers: as
easy as 1, 2, 3, SC'11, doi 10.1145/2063384.2063405). Its 64-bit words become normals by the ziggurat of G. Marsaglia and
W. W. Tsang (J. Statistical Software 5(8), 2000, doi 10.18637/jss.v005.i08), 256 layers of equal area; a word that misses
its layer (1.2 % of them) goes on with words of a counter of its own.

The key is the seed (64 bits). The counter is (sample, pair of channels, attempt, channel within the pair). Pairs from 2^31
on are the uniform numbers that decide which sensors report.
"""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from fdi_gym.kernels import helper, inlined

M0, M1 = uint64(0xD2511F53), uint64(0xCD9E8D57)  # multipliers of Philox4x32
W0, W1 = uint64(0x9E3779B9), uint64(0xBB67AE85)  # what the key grows by in each round
LOW, HALF = uint64(0xFFFFFFFF), uint64(32)
BYTE, SIGN, MANTISSA = uint64(0xFF), uint64(8), uint64(12)  # layer, sign and 52-bit abscissa of a word
DROP, UNIT = uint64(11), 2.0**-53  # a word as a number in [0, 1)
APART = uint64(2**31)  # pairs of channels from here on are no noise

TAIL = 3.6541528853610088  # where the lowest layer ends and the tail begins
AREA = TAIL * math.exp(-0.5 * TAIL**2) + math.sqrt(math.pi / 2) * math.erfc(TAIL / math.sqrt(2))  # of each layer


def ziggurat() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each layer: the bound below which an abscissa is accepted at once, its unit, the density at the layer's end."""
    end = np.empty(257)  # of the layers from the top (1) to the lowest (256), which stands for the tail too
    end[0], end[255], end[256] = 0.0, TAIL, AREA / math.exp(-0.5 * TAIL**2)
    for i in range(254, 0, -1):
        end[i] = math.sqrt(-2.0 * math.log(AREA / end[i + 1] + math.exp(-0.5 * end[i + 1] ** 2)))
    end[0] = 0.0
    layers = np.concatenate([end[256:], end[1:256]])  # layer 0 is the lowest
    inner = np.concatenate([[TAIL, 0.0], end[1:255]])
    return (inner / layers * 2.0**52).astype(np.uint64), layers * 2.0**-52, np.exp(-0.5 * np.append(0.0, end[1:256]) ** 2)


WITHIN, WIDTH, HEIGHT = ziggurat()
SIDE = np.array([1.0, -1.0])


@inlined
def _round(c0, c1, c2, c3, k0, k1, i):
    p0, p1 = M0 * c0, M1 * c2
    k0, k1 = (k0 + uint64(i) * W0) & LOW, (k1 + uint64(i) * W1) & LOW
    return (p1 >> HALF) ^ c1 ^ k0, p1 & LOW, (p0 >> HALF) ^ c3 ^ k1, p0 & LOW


@inlined
def philox(c0, c1, c2, c3, k0, k1):
    """The four 32-bit words of a counter under a key, each in a uint64. Not a loop: so LLVM makes vectors of it."""
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 0)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 1)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 2)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 3)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 4)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 5)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 6)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 7)
    c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1, 8)
    return _round(c0, c1, c2, c3, k0, k1, 9)


@helper
def _missed(word, sample, pair, which, k0, k1):
    """The normal of a word outside its layer's core: wedge, tail, or a new word."""
    attempt = uint64(0)
    while True:
        layer = word & BYTE
        x = np.float64(word >> MANTISSA) * WIDTH[layer]
        sign = SIDE[(word >> SIGN) & uint64(1)]
        if attempt > uint64(0) and (word >> MANTISSA) < WITHIN[layer]:
            return sign * x
        attempt += uint64(1)
        a, b, c, d = philox(sample, pair, attempt, which, k0, k1)
        first, second = np.float64((a | (b << HALF)) >> DROP) * UNIT, np.float64((c | (d << HALF)) >> DROP) * UNIT
        if layer == uint64(0):
            while True:
                beyond, height = -np.log1p(-first) / TAIL, -np.log1p(-second)
                if height + height > beyond * beyond:
                    return sign * (TAIL + beyond)
                attempt += uint64(1)
                a, b, c, d = philox(sample, pair, attempt, which, k0, k1)
                first, second = np.float64((a | (b << HALF)) >> DROP) * UNIT, np.float64((c | (d << HALF)) >> DROP) * UNIT
        if HEIGHT[layer] + (HEIGHT[layer - uint64(1)] - HEIGHT[layer]) * first < np.exp(-0.5 * x * x):
            return sign * x
        word = c | (d << HALF)


@helper
def fill(seed, start, samples, used, words, z):
    """z[s, j] = the normal of channel j at sample start + s, for the channels that are used; the others are left alone.

    Args:
        seed: uint64.
        start: First sample.
        samples: How many of them.
        used: (channels,) bool.
        words: (2, samples or more) uint64, scratch.
        z: (samples or more, channels).
    """
    k0, k1 = seed & LOW, seed >> HALF
    channels = used.size
    for pair in range((channels + 1) // 2):
        j = 2 * pair
        both = j + 1 < channels and used[j + 1]
        if not (used[j] or both):
            continue
        for s in range(samples):  # LLVM makes vectors of this loop
            a, b, c, d = philox(uint64(start + s) & LOW, uint64(pair), uint64(0), uint64(0), k0, k1)
            words[0, s], words[1, s] = a | (b << HALF), c | (d << HALF)
        for which in range(2):
            if not (used[j] if which == 0 else both):
                continue
            for s in range(samples):
                word = words[which, s]
                layer, whole = word & BYTE, word >> MANTISSA
                if whole < WITHIN[layer]:
                    z[s, j + which] = np.float64(np.int64(whole)) * WIDTH[layer] * SIDE[(word >> SIGN) & uint64(1)]
                else:
                    z[s, j + which] = _missed(word, uint64(start + s) & LOW, uint64(pair), uint64(which), k0, k1)


@helper
def white(seed, start, samples, sigma, limit, used, words, z):
    """z[s, j] = the noise of channel j at sample start + s, its normals within `limit`; 0 where the channel is not used."""
    fill(seed, start, samples, used, words, z)
    for s in range(samples):
        for j in range(sigma.size):
            z[s, j] = sigma[j] * min(max(z[s, j], -limit), limit)


@helper
def uniform(seed, sample, channel):
    """A number in [0, 1) for a sample and a channel, apart from all noise."""
    a, b, _, _ = philox(uint64(sample) & LOW, APART + uint64(channel), uint64(0), uint64(0), seed & LOW, seed >> HALF)
    return np.float64((a | (b << HALF)) >> DROP) * UNIT
