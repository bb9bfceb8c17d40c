"""The missile's reference figures: what the study states, and what the data sheet's own implementation measured."""

STUDY = {  # quantity: (the study, the data sheet's implementation)
    "detection time, type 1 [s]": (11.2, 11.21),
    "type 2 excluded, type 1 isolated [s]": (15.5, 15.49),
    "largest residual-to-threshold ratio of estimator 1 from 0.5 s after the alarm on": (None, 0.101),
    "that ratio at the alarm itself": (None, 0.989),
    "approximation, rms error over 15 to 20 s [rad/s^2]": (None, 0.688),
    "fault function, rms over 15 to 20 s [rad/s^2]": (None, 2.933),
    "theta_1 of the matching estimator at 15 s": (None, 0.295),
    "theta_1 of the matching estimator at 20 s": (None, 0.605),
    "theta_2 of the wrong estimator at 18 s": (None, 1.5),
    "Theorem 2's sufficient condition first met [s]": (None, 15.87),
    "mirror: detection time [s]": (None, 12.46),
    "mirror: type 1 excluded [s]": (None, 13.21),
    "mirror: approximation, rms error [rad/s^2]": (None, 0.134),
    "mirror: fault function, rms [rad/s^2]": (None, 0.618),
    "mirror: Theorem 2's condition first met [s]": (None, 13.24),
}

ROBUSTNESS = {  # case: largest ratio (noisy: of the q channel); T_d and T_s as (min, median, max)
    "no fault, noise-free": (0.906, None, None),
    "no fault, noisy": (0.834, None, None),
    "no fault, 64 corners": (0.9905, None, None),
    "type 1, noise-free": (None, (10.22, 11.16, 12.40), (15.31, 15.48, 15.73)),
    "type 1, noisy": (None, (10.55, 11.54, 14.52), (15.39, 15.61, 15.96)),
    "type 2, noise-free": (None, (11.45, 12.47, 12.70), (13.18, 13.21, 13.28)),
    "type 2, noisy": (None, (12.14, 12.72, 12.93), (13.20, 13.26, 13.33)),
}

RATE = {  # (theta, gamma): T_d, T_s of type 1, then of type 2
    (-0.75, 0.2): ((11.21, 15.54), (12.46, 13.22)),
    (0.30, 0.2): ((14.18, 22.76), (12.81, 13.35)),
    (0.75, 0.15): ((11.55, 15.63), (12.55, 13.25)),
    (0.75, 1.0): ((10.38, 10.39), (12.02, 13.07)),
    (1.50, 0.2): ((10.67, 10.88), (12.16, 13.07)),
}

ACCURACY = {  # 600 episodes: at T0 + 2 s, T0 + 4 s, end; standard deviation over 20 groups of 30
    "gos": ((0.382, 0.520, 0.712), (0.095, 0.076, 0.061)),
    "augmented_ekf_bank": ((0.638, 0.815, 0.907), (0.089, 0.084, 0.048)),
    "innovation_oracle": ((0.865, 0.962, 0.988), (0.060, 0.035, 0.016)),
}
COUNTS = [89, 100, 100, 111, 109, 91]
CONFUSION = {
    "gos": [
        [89, 0, 0, 0, 0, 0], [42, 50, 1, 1, 1, 5], [2, 1, 91, 2, 2, 2],
        [13, 44, 8, 41, 2, 3], [0, 0, 1, 0, 108, 0], [34, 9, 0, 0, 0, 48],
    ],
    "augmented_ekf_bank": [
        [89, 0, 0, 0, 0, 0], [10, 85, 4, 1, 0, 0], [0, 1, 99, 0, 0, 0],
        [3, 13, 3, 90, 0, 2], [0, 0, 2, 16, 91, 0], [1, 0, 0, 0, 0, 90],
    ],
    "innovation_oracle": [
        [89, 0, 0, 0, 0, 0], [4, 96, 0, 0, 0, 0], [0, 0, 100, 0, 0, 0],
        [1, 1, 0, 108, 0, 1], [0, 0, 0, 0, 109, 0], [0, 0, 0, 0, 0, 91],
    ],
}  # fmt: skip
STRICT = {  # rows true; columns none, 1..5, several left, all excluded
    "1, 2": [
        [89, 0, 0, 0, 0, 0, 0, 0], [42, 24, 0, 0, 0, 0, 34, 0], [2, 0, 87, 0, 0, 0, 11, 0],
        [13, 42, 2, 0, 0, 0, 48, 6], [0, 0, 10, 0, 0, 0, 0, 99], [34, 1, 25, 0, 0, 0, 28, 3],
    ],
    "1, 2, 3, 4, 5": [
        [89, 0, 0, 0, 0, 0, 0, 0], [42, 0, 0, 0, 0, 0, 58, 0], [2, 0, 5, 0, 0, 0, 93, 0],
        [13, 0, 0, 1, 0, 0, 97, 0], [0, 0, 0, 0, 77, 0, 32, 0], [34, 0, 0, 0, 0, 0, 57, 0],
    ],
}  # fmt: skip
TWO_CLASS = {"strict": (0.491, 0.557, 0.692), "tie-broken": (0.574, 0.699, 0.827)}  # labels 0, 1, 2 only
DELAY = {  # label: detected fraction, quartiles [s]: detector, then EKF bank
    1: ((0.58, 1.63, 2.79, 4.92), (0.90, 0.64, 1.08, 2.95)),
    2: ((0.98, 0.80, 1.32, 2.69), (1.00, 0.44, 0.58, 1.06)),
    3: ((0.88, 0.86, 1.77, 3.80), (0.97, 0.38, 0.66, 2.13)),
    4: ((1.00, 0.16, 0.39, 0.91), (1.00, 0.15, 0.19, 0.30)),
    5: ((0.63, 2.50, 4.25, 6.85), (0.99, 1.32, 2.06, 3.13)),
}
EXCLUSION = {  # true label: share of detected episodes in which class 1..5 is excluded by the end
    1: (0.0, 0.41, 0.00, 0.14, 0.28),
    2: (0.89, 0.0, 0.77, 0.07, 0.77),
    3: (0.08, 0.49, 0.0, 0.09, 0.66),
    4: (1.00, 0.91, 0.76, 0.0, 0.98),
    5: (0.49, 0.07, 0.05, 0.12, 0.0),
}
MAGNITUDE = {1: (0.096, 0.159, 0.421), 2: (0.033, 0.065, 0.401), 3: (0.033, 0.072, 0.249), 5: (0.087, 0.250, 0.650)}
LARGEST = {"alpha [deg]": 12.1, "q [rad/s]": 0.84, "eta [g]": 16.9, "delta [deg]": 23.0}

FAULT_FREE = {"largest residual-to-threshold ratio": 0.854, "largest likelihood ratio": 10.4}
VARIANTS = {  # (noise scale, fault scale): gos, augmented_ekf_bank, innovation_oracle
    (1.0, 1.0): ((0.410, 0.567, 0.743), (0.643, 0.827, 0.913), (0.867, 0.957, 0.997)),
    (2.0, 1.0): ((0.380, 0.517, 0.680), (0.633, 0.800, 0.920), (0.833, 0.950, 0.993)),
    (1.0, 0.5): ((0.357, 0.453, 0.573), (0.560, 0.733, 0.873), (0.800, 0.937, 0.990)),
    (0.5, 1.5): ((0.460, 0.643, 0.833), (0.713, 0.877, 0.927), (0.900, 0.977, 1.000)),
}
HARD = {  # 60 episodes: all, inside, outside
    "augmented_ekf_bank": (0.428, 0.476, 0.405),
    "augmented_ekf_mode_probabilities": (0.541, 0.533, 0.544),
    "augmented_ekf_bank_unlatched": (0.594, 0.346, 0.715),
    "IMM, transition time 4 s": (0.801, 0.515, 0.941),
    "IMM, transition time 1.5 s": (0.826, 0.509, 0.981),
    "oracle": (0.928, 0.776, 1.000),
    "oracle, none not allowed": (0.960, 0.876, 1.000),
}
HARD_EARLY_ALARM = 0.15  # share of episodes in which the detector alarms before the first window
