"""The skid-steer study: open-loop runs, their analysis from a log, and the published figures for comparison."""
