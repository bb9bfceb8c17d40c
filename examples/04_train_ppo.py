"""Train PPO on windows of observations with stable-baselines3, and evaluate the policy as a diagnoser."""

import argparse

import gymnasium as gym
from gymnasium.vector import AutoresetMode
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from baselines.learned.adapters import from_sb3
from fdi_gym.diagnosis import run
from fdi_gym.discovery import load_plant
from fdi_gym.engine import simulate
from fdi_gym.faults import draw
from fdi_gym.sb3 import FDIVecEnv
from fdi_gym.wrappers import DelayAwareReward, VectorHistory

parser = argparse.ArgumentParser()
parser.add_argument("--decisions", type=int, default=20_000)
decisions = parser.parse_args().decisions

if __name__ == "__main__":
    envs = gym.make_vec(
        "B747Lateral-Faults-v0", num_envs=64, units="scaled", decision_period=10, autoreset_mode=AutoresetMode.SAME_STEP
    )
    envs = VectorHistory(DelayAwareReward(envs, patience=10, weights=[0.5, 2, 1.5, 1.5, 1.5]), length=12)
    # a diagnosis never feeds back into the plant: a decision is worth its own reward
    model = PPO("MlpPolicy", VecMonitor(FDIVecEnv(envs)), n_steps=32, batch_size=512, n_epochs=4, gamma=0.0, gae_lambda=0.0)
    model.learn(decisions)
    plant = load_plant("B747Lateral")
    flights = simulate(plant, [draw(plant.process("standard"), 2_000_000 + i) for i in range(50)])
    said = run(from_sb3(model.policy, plant, decision_period=10, length=12), flights.obs)
    for index, label in enumerate(plant.labels):
        mine = flights.label[:, 1:] == index
        print(f"{label.name:15s} {(said.label[:, 1:][mine] == index).mean():.3f} of {mine.sum()} samples right")
