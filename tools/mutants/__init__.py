"""Mutants: small changes of the code that decides about torque, each of which a test must notice."""
