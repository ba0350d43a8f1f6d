"""The `paper` family: published corruption models, reproduced to compare with their tables.

One module per published model; formulas and figures from the papers and from the behaviour of their code, none of that
code. Every quirk is a named switch. The defaults are severity 3 and those of the DSRC paper or its release;
`PUBLISHED` of each module names the settings of each source.

| module            | kinds                                   | models                                            |
|-------------------|-----------------------------------------|---------------------------------------------------|
| `beams`           | beam_missing, cross_sensor              | DSRC, Robo3D, LiDAR-Distillation                  |
| `points`          | motion_blur, crosstalk                  | DSRC, Robo3D                                      |
| `incomplete_echo` | incomplete_echo                         | Robo3D                                            |
| `fog`             | fog                                     | Hahner et al. (ICCV 2021), as in DSRC and Robo3D  |
| `snow`            | snow                                    | Hahner et al. (CVPR 2022), as in DSRC and Robo3D  |
| `wet_ground`      | wet_ground                              | Hahner et al. (CVPR 2022), as in Robo3D           |
| `rain`            | rain                                    | LISA (Kilic et al. 2021), as in 3D_Corruptions_AD |

The models act on clouds, rows of x, y, z, intensity (see `cloud`), by the `apply_...` function of each module;
`corrupt` and its likes convert a sweep there and back, with the intensity clipped to [0, 1] and every point's fate.
Sources: DSRC (Terry9a/DSRC); Robo3D (Kong et al., ICCV 2023); 3D_Corruptions_AD (Dong et al., CVPR 2023); LISA (Kilic
et al. 2021); LiDAR-Distillation (Wei et al., ECCV 2022).
"""
