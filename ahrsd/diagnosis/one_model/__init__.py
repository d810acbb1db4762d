"""Diagnosis by one generative model: components with priors, one evidence, one search (beta)."""
