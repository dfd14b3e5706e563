"""Matched sets: videos that share a scene and differ in one thing.

Video i is member i % members of set i // members. All members share the set's key, and therefore factors, positions,
look, camera and noise. Member 0 is the original. The others are counterfactuals (an object is removed, or a factor has
another value from the start) or violations (an impossible event happens during the video). One loop simulates each
video twice: first as the original, then as the member, from the change on. Everything before the change, and everything
that the change does not affect, equals the original to the bit.
"""
