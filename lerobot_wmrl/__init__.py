"""World models for LeRobot: imagine a robot's next observation, reward and done, and train policies inside.

Notation used as tensor suffixes across the package:
B batch (environments), T time (frames), S tokens a frame, C channels or code factors, D model width,
H image height, W image width, A action size, P proprioceptive state size, V code levels of one factor.
"""
