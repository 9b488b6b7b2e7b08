"""MaxBotix MB7360, an ultrasonic range finder, for monstertruckd."""
