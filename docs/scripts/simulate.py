import uwbslam_jax as us

simulation = us.simulate("hall", seed=1, duration=30.0, beams=361)
result = us.run(simulation)
for name, value in us.evaluate(result, simulation.truth).items():
    print(name, value)
