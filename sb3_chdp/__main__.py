from sb3_chdp.cli import main

main()
