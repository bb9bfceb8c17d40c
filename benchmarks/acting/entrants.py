"""Who enters the suites whose flights are acted on."""

from fdi_gym.diagnosis import diagnosers

ALLOWING = ("null", "truth", "false_alarm", "random")
PROBING = ("periodic_probes_10", "periodic_probes_30", "always_probes", "random_probes_30", "greedy_probes")
EVERY = tuple(diagnosers())  # of whom those enter that can run on the plant; on the satellite, hours of them

ENTRANTS = {
    "b747-active": (
        *EVERY, "periodic_probes_5", *PROBING, "greedy_probes_w0.3", "greedy_probes_w3", "greedy_probes_w10", "ppo_probes",
        "ppo_probes_w3", "ppo_probes_discount_0", "recurrent_ppo_probes",
    ),
    "cmg-active": (
        "null", "random", "mekf", "joint_ukf", "caukf", "gaukf", "sgaukf", "augmented_ekf", "augmented_ekf_glr",
        "augmented_ekf_cusum", "augmented_ekf_chi_square", "augmented_ekf_thresholds", "augmented_ukf", "two_stage_ekf",
        "multiple_model_ekf", "windowed_nis", "sequence_net", "residual_net", "ppo", "pca", "dynamic_pca", "cva",
        "cramer_rao_oracle", "mekf_clairvoyant", *PROBING,
    ),
    "huav-active": ("multiple_model_ekf", "hypothesis_bank", "augmented_ekf", *PROBING, "greedy_probes_w0.3"),
    "missile-active": ("augmented_ekf", "mode_pursuit_ekf", "multiple_model_ekf", *PROBING, "greedy_probes_w0.3"),
    "tank-active": ("mode_pursuit_ekf", "augmented_ekf", "multiple_model_ekf", *PROBING, "greedy_probes_w0.3"),
    "b747-accommodation": (*ALLOWING, "bayes_bank", "two_stage_kf", "augmented_ekf"),
    "cmg-accommodation": (*ALLOWING, "mekf"),
    "huav-accommodation": (*ALLOWING, "hypothesis_bank", "augmented_ekf"),
    "huav-accommodation-hard": (*ALLOWING, "augmented_ekf"),
    "missile-accommodation": (*ALLOWING, "augmented_ekf"),
    "tank-accommodation": (*ALLOWING, "mode_pursuit_ekf", "augmented_ekf"),
}  # fmt: skip
