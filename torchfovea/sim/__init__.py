"""The simulated world: MuJoCo scenes, renderers and the head; MuJoCo stops here, outwards all is tensors in E."""
