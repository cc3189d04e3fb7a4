"""Servers of LITMUS^RT: the paper's own back end."""
