"""The program in the child: NumPy and the standard library only, and nothing of the rest of this package.

The child gets this folder under the name ``hipg_inside``, so its modules import each other relatively.
"""
