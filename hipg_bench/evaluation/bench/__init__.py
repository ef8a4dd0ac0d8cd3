"""Speed and memory: every figure stands beside another that was measured in the same run.

Machines are noisy, so what is compared takes turns in short chunks, and ratios are medians over the
turns (`timing`); what needs its own memory figure runs in a process of its own (`child`).
"""
