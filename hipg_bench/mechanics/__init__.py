"""The rules of harm, radio, sensing and coverage, as pure functions of arrays. No MuJoCo, no randomness.

Laws (`hazards`, `health`) are written against the array API standard, so that they run on NumPy today and on
torch over a GPU engine later. What agents find around them (`plane`, `looks`, `sensing`) are plain loops over
worlds without a word of Python in them, compiled for the processor today; such loops compile for a GPU too.
"""
