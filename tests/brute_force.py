"""Bayes' rule by brute force for the banks over events, and a bank's way through a recording."""

import numpy as np
from scipy.stats import multivariate_normal

from fdi_gym.estimation.events import WANDERS
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

    The joint Gaussian of all states is propagated, and with it the covariance of the present one with each measurement. Of a
    sensor that is frozen a reading has a density of its own where it comes again, and is impossible where it does not.
    """
    f, width = events.direction.shape[2], model.z.stop - model.z.start
    y, u, _ = plant.split(obs)
    m, mean, P, line = len(model.R), model.X0.copy(), model.P0.copy(), model
    means, past, S, heard = [], [], np.zeros((len(obs) * m,) * 2), np.ones((len(obs), m), bool)
    for k in range(len(obs)):
        at = Interval(np.array([k]), u[k][None], None, np.zeros((1, 0)))
        if k:
            offset, direction = np.zeros((1, len(events.entries))), np.zeros((1, len(events.entries), width))
            change, fresh = np.ones(len(mean)), np.zeros(len(mean))
            for place, (kind, step) in enumerate(beginnings):
                own = slice(place * f, (place + 1) * f)
                x = slice(model.z.start + own.start, model.z.start + own.stop)
                if k == step + 1:
                    P[x, x] = np.diag(events.direction[kind].any(axis=0).astype(float))
                if k > step:
                    offset[0] += events.offset[kind]
                    direction[0, :, own] = events.direction[kind]
                    if events.course[kind] == WANDERS:
                        change[x], fresh[x] = events.first[kind], 1.0 - events.first[kind] ** 2
                    if events.frozen[kind] >= 0:
                        heard[k, model.sensors.tolist().index(events.frozen[kind])] = False
            line = model.replace(lines=(offset, direction))
            moved, F = line.jacobian_f(mean[None], at)
            A = change[:, None] * F[0]
            mean, P = change * moved[0], A @ P @ A.T + np.outer(change, change) * model.Q[0] + np.diag(fresh)
            past = [A @ c for c in past]
        read, H = (a[0] for a in line.jacobian_h(mean[None], at))
        means.append(read)
        rows = slice(k * m, (k + 1) * m)
        for j, c in enumerate(past):
            S[rows, j * m : (j + 1) * m] = H @ c
            S[j * m : (j + 1) * m, rows] = (H @ c).T
        S[rows, rows] = H @ P @ H.T + model.R
        past.append(P @ H.T)
    use = heard.ravel()
    found = multivariate_normal.logpdf(y[:, model.sensors].ravel()[use], np.concatenate(means)[use], S[np.ix_(use, use)])
    for kind, step in beginnings:
        if events.frozen[kind] >= 0:
            same = np.diff(y[step:, events.frozen[kind]]) == 0.0
            sigma = plant.outputs[events.frozen[kind]].sigma
            found += same.sum() * (10.0 - 0.5 * np.log(2 * np.pi * sigma**2)) if same.all() else -np.inf
    return found
