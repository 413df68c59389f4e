"""Motion of the ego vehicle: odometry from scans, de-skewing of scans."""
