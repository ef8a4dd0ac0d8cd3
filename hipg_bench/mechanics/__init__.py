"""The rules of harm, radio, sensing and coverage, as pure functions of arrays. No MuJoCo, no randomness.

Laws (`hazards`, `health`) are written against the array API standard. What agents find around them (`plane`,
`looks`, `sensing`) are plain loops over worlds, compiled for the processor.
"""
