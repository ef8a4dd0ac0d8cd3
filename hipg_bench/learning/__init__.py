"""Learners: small pure functions, and one file per learner that reads top to bottom."""
