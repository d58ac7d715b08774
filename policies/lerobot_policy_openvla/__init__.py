"""OpenVLA (Kim et al. 2024) as a LeRobot policy: an image and an instruction in, seven action tokens out."""
