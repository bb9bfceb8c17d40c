"""Causal attention as it is trained; `baselines.learned.attention` runs it step by step, without torch."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from baselines.learned.attention import EPSILON, HEADS, LAYERS, WIDER, WINDOW


class Attention(nn.Module):
    """What is remembered at each step of x (N, T, hidden), beside x itself."""

    def __init__(self, hidden: int):
        super().__init__()
        self.before = nn.ModuleList([nn.LayerNorm(hidden, EPSILON) for _ in range(LAYERS)])
        self.ask = nn.ModuleList([nn.Linear(hidden, 3 * hidden) for _ in range(LAYERS)])
        self.slope = nn.ParameterList([nn.Parameter(torch.linspace(-1.0, -6.0, HEADS)) for _ in range(LAYERS)])
        self.join = nn.ModuleList([nn.Linear(hidden, hidden) for _ in range(LAYERS)])
        self.between = nn.ModuleList([nn.LayerNorm(hidden, EPSILON) for _ in range(LAYERS)])
        self.up = nn.ModuleList([nn.Linear(hidden, WIDER * hidden) for _ in range(LAYERS)])
        self.down = nn.ModuleList([nn.Linear(WIDER * hidden, hidden) for _ in range(LAYERS)])

    def forward(self, x: Tensor, h: Tensor | None = None) -> tuple[Tensor, Tensor | None]:
        """Called as a recurrent layer is; it always begins at the first step."""
        N, T, hidden = x.shape
        k = torch.arange(T, device=x.device)
        back = (k[:, None] - k).to(x.dtype)
        seen = (back >= 0) & (back < WINDOW)
        y = x
        layers = zip(self.before, self.ask, self.slope, self.join, self.between, self.up, self.down, strict=True)
        for before, ask, slope, join, between, up, down in layers:
            q, key, value = (a.view(N, T, HEADS, -1).transpose(1, 2) for a in ask(before(y)).chunk(3, dim=-1))
            bias = (-torch.exp(slope)[:, None, None] * back).masked_fill(~seen, -torch.inf)
            found = F.scaled_dot_product_attention(q, key, value, attn_mask=bias.to(x.dtype))
            y = y + join(found.transpose(1, 2).reshape(N, T, hidden))
            y = y + down(F.silu(up(between(y))))
        return y - x, h
