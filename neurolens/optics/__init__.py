"""The exact lens: prescriptions, glass, coatings, the tracer, first-order data, states. Imports only torch and numpy.

    prescription          Lens (`at`, `scaled`), Surface, Coating, Configuration
    lensfile, lenswriter  TOML files
    trace                 trace, compile_trace, Rays, ray differentials; `sequence` follows ghosts
    surfaces, shapes      spheres and planes, conics and aspheres; `passing` one surface with its tests
    paraxial              first_order; `states` and `focusing` what one changes
    catalogue, glass      dispersion and absorption; `designs`, `coatings`, `transmission` thin films
    pupils                where light passes; `pupil_methods` those of the literature
    lenscheck, rims       whether a table agrees with its source, and rims for one without; `aiming` rays to its stop

Prescriptions, their files, glass and first-order data load without torch; cameras use `sag`, `film_plane`, `apertures`.
"""
