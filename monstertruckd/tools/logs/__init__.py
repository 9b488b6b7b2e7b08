"""What is made of logs: lists, summaries, exports, reports, pictures, replays."""
