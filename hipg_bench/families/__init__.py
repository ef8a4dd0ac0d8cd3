"""The task families: one file each, read top to bottom.

A family file holds the physics and the rules; a task file in ``tasks/`` holds the numbers.
"""
