"""The paper's comparison from finished runs: artefacts, curves, figures and verdicts."""
