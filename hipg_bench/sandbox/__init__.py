"""Running code of others: child processes that see their observations and little else.

``process`` is the parent's side with the clocks, ``inside`` the program in the child, ``bubblewrap`` and
``landlock`` are ways to lock the child in, and ``probe`` tries what they are worth on this machine.
"""
