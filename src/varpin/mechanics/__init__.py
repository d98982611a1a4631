"""Discrete mechanics: the Lagrangian, forces, noise, controls, the scene that holds them."""
