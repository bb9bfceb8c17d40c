"""Bayes' rule by brute force for the banks over events, and a bank's way through a recording."""

import numpy as np
from scipy.stats import multivariate_normal

from fdi_gym.estimation.interval import Interval


def states(plant, bank, obs):
    """The state of a bank after each sample of observations (n, K + 1, n_obs)."""
    s = bank.start(len(obs))
    y, u, known = plant.split(obs)
    for k in range(obs.shape[1]):
        at = Interval(np.full(len(obs), k), u[:, k], None, known[:, k])
        s = bank.predict(s, at) if k else s
        s = bank.update(s, at, y[:, k], np.ones_like(y[:, k], bool))
        yield s


def log_density(plant, model, events, obs, beginnings):
    """Log density of all measurements (K + 1, n_obs) if events of these kinds begin at these steps, and stay.

    The joint Gaussian of all states is propagated, and with it the covariance of the present one with each measurement.
    """
    f, width = events.direction.shape[2], model.z.stop - model.z.start
    y, u, _ = plant.split(obs)
    m, mean, P = len(model.R), model.X0.copy(), model.P0.copy()
    means, past, S = [], [], np.zeros((len(obs) * m,) * 2)
    for k in range(len(obs)):
        if k:
            offset, direction = np.zeros((1, len(events.entries))), np.zeros((1, len(events.entries), width))
            for place, (kind, step) in enumerate(beginnings):
                own = slice(place * f, (place + 1) * f)
                if k == step + 1:
                    x = slice(model.z.start + own.start, model.z.start + own.stop)
                    P[x, x] = np.diag(events.direction[kind].any(axis=0).astype(float))
                if k > step:
                    offset[0] += events.offset[kind]
                    direction[0, :, own] = events.direction[kind]
            line, at = model.replace(lines=(offset, direction)), Interval(np.array([k]), u[k][None], None, np.zeros((1, 0)))
            moved, F = line.jacobian_f(mean[None], at)
            mean, P, past = moved[0], F[0] @ P @ F[0].T + model.Q[0], [F[0] @ c for c in past]
        means.append(model.H @ mean)
        rows = slice(k * m, (k + 1) * m)
        for j, c in enumerate(past):
            S[rows, j * m : (j + 1) * m] = model.H @ c
            S[j * m : (j + 1) * m, rows] = (model.H @ c).T
        S[rows, rows] = model.H @ P @ model.H.T + model.R
        past.append(P @ model.H.T)
    return multivariate_normal.logpdf(y[:, model.sensors].ravel(), np.concatenate(means), S)
