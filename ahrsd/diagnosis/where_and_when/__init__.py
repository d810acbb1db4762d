"""In which intervals, frames and conditions readings and model differ."""
