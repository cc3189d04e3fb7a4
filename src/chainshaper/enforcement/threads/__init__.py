"""Threads of an application: finding them, naming them, giving them to servers."""
