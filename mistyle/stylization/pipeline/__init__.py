"""Stylization jobs: their stages, plans and memory budgets."""
