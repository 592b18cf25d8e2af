#!/usr/bin/env bash
# One would guess: sequences from skrl's replay memory are stretches of experience in the order it was made.
# What happens: once the memory is full, a sequence may run across the row to be overwritten next: the newest step is
# followed by the oldest, and no `terminated` or `truncated` marks the seam.
# For this field: a recurrent agent resets its state only at those flags, so it carries a state from the newest episode
# into the oldest: in 7% of sequences of 64 from a memory of 1,000 steps. Sample whole episodes instead.
set -eu
tmp=$(mktemp -d)
trap 'rm -rf "$tmp"' EXIT
python3 -m venv "$tmp/venv"
"$tmp/venv/bin/pip" install --quiet "torch>=2.11,<2.14" skrl==2.1.1 gymnasium==1.4.0 numpy==2.4.6
OMP_NUM_THREADS=1 "$tmp/venv/bin/python" -W ignore - << 'PY'
import skrl
import torch
from skrl.memories.torch import RandomMemory

print("skrl", skrl.__version__, "torch", torch.__version__)
SIZE, LENGTH, EPISODE, DRAWN = 1000, 64, 100, 20_000
for envs in (1, 4):
    torch.manual_seed(0)
    memory = RandomMemory(memory_size=SIZE, num_envs=envs, device="cpu")
    memory.create_tensor("step", size=1)
    memory.create_tensor("truncated", size=1, dtype=torch.bool)
    for step in range(SIZE * 5 // 4):
        ends = torch.full((envs, 1), step % EPISODE == EPISODE - 1)
        memory.add_samples(step=torch.full((envs, 1), float(step)), truncated=ends)
    ((step, truncated),) = memory.sample(["step", "truncated"], batch_size=DRAWN, sequence_length=LENGTH)
    step, truncated = step.view(-1, LENGTH), truncated.view(-1, LENGTH)
    jump = step.diff(dim=1) != 1
    unmarked = jump & ~truncated[:, :-1]
    row = int(jump.any(1).nonzero()[0])
    at = int(jump[row].nonzero()[0])
    share, crossing = unmarked.any(1).double().mean().item(), (LENGTH - 1) / (SIZE - LENGTH + 1)
    print(f"{envs} environments: {share:.1%} of sequences have an unmarked jump; {crossing:.1%} if none is avoided")
    print(f"  such as from step {step[row, at]:.0f} to step {step[row, at + 1]:.0f}")
    assert abs(share - crossing) < 0.01, "sequences do not cross the newest step unmarked"
PY
