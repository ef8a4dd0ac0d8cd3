"""Policies: pure objects that map what a team sees to what it does, and the bundles they come in."""
