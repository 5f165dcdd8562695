"""Learned policies as C: a QP whose theta is fixed, solved by a dual active-set method."""
