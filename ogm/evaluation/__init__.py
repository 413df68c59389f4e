"""Evaluation of sensor models and maps against the truth, frame by frame."""
