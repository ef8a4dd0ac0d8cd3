"""The rules of harm, radio, sensing and coverage, as pure functions of (B, N, ...) arrays.

Written against the array API standard, so that they run on NumPy today and on torch over a GPU
engine later. No MuJoCo, no randomness, no loop over environments.
"""
