"""Submissions: agent bundles on their way from who trained them to the leaderboard."""
