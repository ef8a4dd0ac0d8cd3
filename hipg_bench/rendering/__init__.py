"""Pictures of worlds, made from saved state rows.

`film.record` is the way in: it renders in a child process, so that the process that scores never
needs OpenGL. `gl` says which backend works here.
"""
