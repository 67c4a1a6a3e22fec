"""Dressed people: garments that fit every identity of Anny, draped over it in every pose."""
