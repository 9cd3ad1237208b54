"""The paper's six worlds: Task, spec and laws of each, importable without a simulator."""
