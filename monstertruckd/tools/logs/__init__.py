"""Tools on logs: lists, summaries, exports, reports, viewers, replay."""
