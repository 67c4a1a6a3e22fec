"""The dsffnet command."""
