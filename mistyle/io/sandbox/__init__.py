"""Sandbox: untrusted files are decoded in a child process with limits on memory, time and file access."""
